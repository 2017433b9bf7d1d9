"""Sections of a run file about a frame: the frame itself, its sources, where it points.

`settings` has the other sections and reads run files.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from bayesfred.io.tangent_plane import Parity
from bayesfred.settings.sections import Float, Name, Positive, Section

__all__ = ["CatalogueSettings", "FrameSettings", "SkySettings", "TargetSettings"]

_Degrees = Annotated[float, Field(ge=-360, le=360)]
_Declination = Annotated[float, Field(ge=-90, le=90)]


class FrameSettings(Section):
    """`[frame]`: the frame of counts, as `bayesfred.io.frames.read_frame` takes it.

    Attributes
    ----------
    path : str
        The frame's file.
    gain : float, optional, e-/adu
        Counts are (stored - pedestal) * gain; by default the header's.
    pedestal : float, optional, stored units
        Level that no light would give, by default 0.
    saturation : float, optional, stored units
        Pixels at or above this level are masked; by default the header's, or what seems saturated.
    name : str, optional
        FITS extension or HDF5 dataset.
    gain_map : str, optional
        The file of the gain of every pixel, in place of `gain`.
    flat : str, optional
        The file of a flat field, the relative response of every pixel, by which counts are divided.
        Pixels where it is not between 0.01 and 100, such as dead ones, are masked.
    variance : str, optional, e-^2
        The file of a map of the read-out's variance, whose root is the read noise.
    background_scale : float, optional, recorded pixel
        At every so many pixels the structure of the background is measured outside the footprints;
        it is subtracted, see `bayesfred.subtract_background`. By default nothing is.
    noise_correlation_ratio : float, optional
        Of a frame whose neighbouring pixels share noise, see `bayesfred.CorrelatedNoise`; by
        default pixels are independent.
    reject_outliers : bool
        Whether unmatched sources and spurious detections are left out, see
        `bayesfred.reject_outliers`, and hot pixels before anything is searched for. At the maximum
        single sources that do not fit are left out, unless they are more than a tenth of all or
        the brightest.
    """

    path: Name
    gain: Positive | None = None
    pedestal: Float | None = None
    saturation: Float | None = None
    name: Name | None = None
    gain_map: Name | None = None
    flat: Name | None = None
    variance: Name | None = None
    background_scale: Positive | None = None
    noise_correlation_ratio: Annotated[Float, Field(ge=0.1, le=10)] | None = None
    reject_outliers: bool = False

    @property
    def maps(self) -> dict[str, str]:
        """The files of maps of the pixels, by name."""
        given = {"gain": self.gain_map, "flat": self.flat, "variance": self.variance}
        return {name: path for name, path in given.items() if path is not None}


class TargetSettings(Section):
    """`[catalogue.grid]`: a target that is indexed from the frame; `optimize.grid_target` does it.

    Attributes
    ----------
    rows, columns : int
        Of the target.
    pitch : float, optional, recorded pixel
        Distance between neighbours; found from the frame, and compared with this.
    layout : {'square', 'hexagonal'}
    marks : {'pinholes', 'dots'}
        Bright on dark, or dark on bright.
    """

    rows: Annotated[int, Field(ge=3, le=10_000)]
    columns: Annotated[int, Field(ge=3, le=10_000)]
    pitch: Positive | None = None
    layout: Literal["square", "hexagonal"] = "square"
    marks: Literal["pinholes", "dots"] = "pinholes"


class CatalogueSettings(Section):
    """`[catalogue]`: the known sources, by their positions on the object plane or on the sky.

    Attributes
    ----------
    path : str, optional
        The catalogue's file.
    grid : TargetSettings, optional
        A target without a list of positions, in place of the file.
    x, y : str
        Columns of the positions, pixel from the middle of the frame.
    ra, dec : str, optional
        Columns of right ascension and declination (ICRS), in place of x and y: in the unit of the
        column, degrees without one, or texts such as 12:34:56.7.
    pm_ra, pm_dec : str, optional
        Columns of the proper motions, in the unit of the column, milliarcsecond a year without one;
        along right ascension with the cosine of the declination.
    epoch : float, optional, Julian year
        Of ra and dec; needed with proper motions.
    flux : str
        Column of the fluxes, counts; not needed where [nuisances] has them free.
    magnitude : str, optional
        Column of magnitudes, in place of fluxes.
    zero_point : float, optional
        Magnitude of a source of one count; goes with `magnitude`.
    """

    path: Name | None = None
    grid: TargetSettings | None = None
    x: Name = "x"
    y: Name = "y"
    ra: Name | None = None
    dec: Name | None = None
    pm_ra: Name | None = None
    pm_dec: Name | None = None
    epoch: Annotated[float, Field(ge=1000, le=3000)] | None = None
    flux: Name = "flux"
    magnitude: Name | None = None
    zero_point: Float | None = None

    @model_validator(mode="after")
    def _both_or_neither(self) -> CatalogueSettings:
        for pair in (("magnitude", "zero_point"), ("ra", "dec"), ("pm_ra", "pm_dec")):
            _together(self, *pair)
        if (self.path is None) == (self.grid is None):
            got = "neither path nor grid" if self.path is None else "path and grid"
            raise ValueError(f"got {got}, expected one of them")
        if self.grid is not None and self.model_fields_set - {"grid", "x", "y", "flux"}:
            raise ValueError("got columns of a file, expected none with a grid")
        if self.ra is not None and (self.x, self.y) != ("x", "y"):
            raise ValueError("got x or y, expected them without ra and dec only")
        if self.pm_ra is not None and self.epoch is None:
            raise ValueError("got proper motions without epoch, expected it: 2016.0 for Gaia DR3")
        if self.ra is None and (self.pm_ra or self.epoch):
            raise ValueError("got pm_ra or epoch, expected them with ra and dec only")
        return self


class SkySettings(Section):
    """`[sky]`: where the frame points, for a catalogue with ra and dec.

    The pose is searched for within 1 degree of the pointing and 5 % of the scale. Without them the
    coordinate system in the frame's header is used in their place. Where a symmetric catalogue fits
    as well otherwise, angle and parity have to be given, or be the header's within 5 degrees.

    Attributes
    ----------
    pointing : (float, float), optional, degree
        Right ascension and declination (ICRS) of the middle of the frame.
    pixel_scale : float, optional, arcsecond per recorded pixel
    position_angle : float, optional, degree
        Angle from the north through the east to the direction in which rows are counted; by default
        any.
    parity : {'sky', 'mirrored'}, optional
        With rows counted upwards and north up, whether east is on the left, as on the sky, or on
        the right; by default either.
    date : str, optional
        When the frame was taken, ISO 8601, for proper motions; by default the header's DATE-OBS.
    """

    pointing: tuple[_Degrees, _Declination] | None = None
    pixel_scale: Positive | None = None
    position_angle: _Degrees | None = None
    parity: Parity | None = None
    date: Name | None = None

    @model_validator(mode="after")
    def _both_or_neither(self) -> SkySettings:
        _together(self, "pointing", "pixel_scale")
        return self


def _together(section: Section, one: str, other: str) -> None:
    """Refuse one of two keys alone."""
    given = [key for key in (one, other) if getattr(section, key) is not None]
    if len(given) == 1:
        raise ValueError(f"got {given[0]} alone, expected {one} and {other} together")

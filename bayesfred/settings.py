"""The run file: one TOML file that says what a run fits, to what, and how.

Each section is a frozen model with the keys, units and defaults of the run file;
:func:`read_settings` checks all of them at once and says every mistake in one line. The sections
`[detector]`, `[psf]`, `[noise]` and `[nuisances]` have the fields of the class that they describe,
see `sections`; `kind` names the class. `build` makes the objects. `sections.toml` gives the text
that result files keep. `example.toml` beside this module is a complete run file.
"""

from __future__ import annotations

import json
import tomllib
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, PlainValidator, ValidationError, model_validator

from bayesfred._typing import PathLike
from bayesfred.errors import InputError
from bayesfred.io.tangent_plane import Parity
from bayesfred.sections import (
    TOO_DEEP,
    Count,
    DistortionSettings,
    Float,
    Name,
    Positive,
    Section,
    Seed,
    described,
    mistake,
)
from bayesfred.simulation_sections import DesignSettings, SimulationSettings, StudySettings

__all__ = ["PriorSettings", "RunSettings", "read_settings"]

_Degrees = Annotated[float, Field(ge=-360, le=360)]
_Declination = Annotated[float, Field(ge=-90, le=90)]

# Sections with the fields of a class: `ObjectSettings`.
_Detector = Annotated[Any, PlainValidator(partial(described, "detector"))]
_PSF = Annotated[Any, PlainValidator(partial(described, "psf"))]
_Noise = Annotated[Any, PlainValidator(partial(described, "noise"))]
_Nuisances = Annotated[Any, PlainValidator(partial(described, "nuisances"))]


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
    reject_outliers : bool
        Whether unmatched sources and spurious detections are left out:
        `bayesfred.reject_outliers`.
    """

    path: Name
    gain: Positive | None = None
    pedestal: Float | None = None
    saturation: Float | None = None
    name: Name | None = None
    reject_outliers: bool = False


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
    coordinate system in the frame's header is used in their place.

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


class ModelSettings(Section):
    """`[model]`: how expected counts are computed.

    Attributes
    ----------
    conserve_flux : bool
        Whether the kernel includes the determinant that keeps each source's flux.
    tolerance : float
        Pixels where the PSF is below this part of its peak are left out.
    """

    conserve_flux: bool = True
    tolerance: Annotated[float, Field(ge=0, lt=1)] = 1e-8


class PriorSettings(Section):
    """`[prior.NAME]`: the prior of one parameter, a distribution of `scipy.stats`.

    Attributes
    ----------
    distribution : str
        Its name, such as 'norm'. Every other key of the table is one of its keyword parameters, a
        float.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float] = Field(init=False)

    distribution: Name

    @property
    def keywords(self) -> dict[str, float]:
        """Keyword parameters of the distribution."""
        return dict(self.__pydantic_extra__)


class SamplingSettings(Section):
    """`[sampling]`: how long and how widely to sample.

    Attributes
    ----------
    seed : int
        Seed of every random number.
    ensembles : int
        Independent ensembles.
    walkers : int
        Walkers in each, an even number.
    target_ess : int
        Effective samples of the slowest parameter at which sampling stops.
    steps : int, optional
        Total number of steps in place of that rule.
    """

    seed: Seed = 1
    ensembles: Annotated[int, Field(ge=2, le=1000)] = 4
    walkers: Annotated[int, Field(ge=4, le=10_000, multiple_of=2)] = 32
    target_ess: Count = 1000
    steps: Count | None = None


class OutputSettings(Section):
    """`[output]`: where the run is stored.

    Attributes
    ----------
    path : str, optional
        The chain file, .h5, inside the folder that the run is started in.
    """

    path: Annotated[str, Field(pattern=r"\.h5$")] | None = None


class RunSettings(Section):
    """A whole run file, one attribute a section.

    Attributes
    ----------
    frame, catalogue, psf, distortion
        Sections that every run file has.
    sky, detector, model, noise, nuisances, sampling, output
        Sections with defaults.
    prior : dict of PriorSettings
        Priors by parameter name, in place of the default ones.
    simulation : SimulationSettings, optional
        Used by `bayesfred simulate`, `bayesfred study` and `bayesfred design`.
    study : StudySettings, optional
        Used by `bayesfred study` only.
    design : DesignSettings, optional
        Used by `bayesfred design` only.
    """

    frame: FrameSettings
    catalogue: CatalogueSettings
    sky: SkySettings = SkySettings()
    detector: _Detector = described("detector", {})
    psf: _PSF
    distortion: DistortionSettings
    model: ModelSettings = ModelSettings()
    noise: _Noise = described("noise", {})
    nuisances: _Nuisances = described("nuisances", {})
    prior: dict[str, PriorSettings] = Field(default_factory=dict)
    sampling: SamplingSettings = SamplingSettings()
    output: OutputSettings = OutputSettings()
    simulation: SimulationSettings | None = None
    study: StudySettings | None = None
    design: DesignSettings | None = None

    def seeded(self, seed: int) -> RunSettings:
        """The same run with other random numbers, and without a study or a design."""
        parts = {"sampling": self.sampling, "simulation": self.simulation}
        update = {
            key: part.model_copy(update={"seed": seed})
            for key, part in parts.items()
            if part is not None
        }
        return self.model_copy(update={**update, "study": None, "design": None})


def read_settings(path: PathLike) -> RunSettings:
    """Read and check a run file.

    Parameters
    ----------
    path : path-like
        A TOML file such as `example.toml` beside this module.

    Returns
    -------
    RunSettings

    Raises
    ------
    InputError
        The file is missing or is not TOML; a key is unknown, missing or has a value out of range.
        All mistakes are named in the one line.

    Examples
    --------
    >>> import bayesfred.settings
    >>> read_settings(Path(bayesfred.settings.__file__).with_name("example.toml")).psf.sigma
    10.0
    """
    path = Path(path)
    try:
        # A byte order mark, which some editors write, is not TOML.
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        # The rules are those of JSON. Dates, which only TOML has, are no key's type.
        return RunSettings.model_validate_json(
            json.dumps(table, default=lambda date: {str(date): "date"})
        )
    except FileNotFoundError:
        raise InputError(f"{path}: no such file, expected a run file; check the path") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}), expected a run file"
        ) from error
    except RecursionError:
        raise InputError(f"{path}: {TOO_DEEP}") from None
    except ValidationError as error:
        errors = error.errors(include_url=False)
        mistakes = "; ".join(mistake(details, RunSettings, table) for details in errors)
        raise InputError(" ".join(f"{path}: {mistakes}".split())) from None
    # TOML syntax (its text gives line and column) and text that is not UTF-8
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: not TOML ({reason}), expected sections of key = value"
        ) from error

"""A calibration as a generalized world coordinate system: gwcs, kept in ASDF files.

The steps are those of a SIP header, with the pixels counted from 0:

    pixel -> from the reference pixel -> polynomials -> CD -> TAN -> rotation to ICRS.

Each step has an inverse. That of the polynomials is the pair of polynomials that a header has as AP
and BP. The file holds the table of draws as well, named as the keywords of a header.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units
from astropy.coordinates import ICRS
from astropy.modeling import Model, models
from astropy.table import Table

from bayesfred._typing import PathLike
from bayesfred.calibration.plate import Truncation, known_sky, nodes, objects, truncation
from bayesfred.calibration.wcs import sip
from bayesfred.errors import InputError
from bayesfred.io.atomic import replace
from bayesfred.io.paths import may_write

if TYPE_CHECKING:
    from bayesfred.calibration.calibration import Calibration

__all__ = ["GeneralizedWCS", "generalized_wcs"]


@dataclass(frozen=True, eq=False)
class GeneralizedWCS:
    """A calibration as a gwcs.

    Attributes
    ----------
    wcs : gwcs.WCS
        From columns and rows, counted from 0, to ICRS.
    draws : astropy.table.Table
        A row for every draw; columns as `wcs.sip` names them, CRPIX counted from 1.
    forward, inverse : Truncation
        Errors of the gwcs against the calibration: where pixels point, and where directions are
        imaged.
    """

    wcs: Any
    draws: Table
    forward: Truncation
    inverse: Truncation

    def write(self, path: PathLike, *, overwrite: bool = False) -> None:
        """Write an ASDF file with `wcs`, `draws` and `truncation_error` in pixels.

        Parameters
        ----------
        path : path-like
        overwrite : bool
            Replace a file that exists.

        Raises
        ------
        InputError
            If the file exists or cannot be written, or asdf-astropy is not installed.
        """
        asdf, _ = _packages()
        may_write(path, overwrite=overwrite)
        errors = {
            way: {"rms": each.rms, "largest": each.largest, "unit": "pixel"}
            for way, each in (("forward", self.forward), ("inverse", self.inverse))
        }
        tree = {"wcs": self.wcs, "draws": self.draws, "truncation_error": errors}
        buffer = io.BytesIO()
        asdf.AsdfFile(tree).write_to(buffer)
        replace(Path(path), buffer.getvalue())


def generalized_wcs(calibration: Calibration, degree: int = 3) -> GeneralizedWCS:
    """A calibration as a gwcs.

    Parameters
    ----------
    calibration : Calibration
    degree : int
        Of the polynomials, from 2 to 9.

    Returns
    -------
    GeneralizedWCS

    Raises
    ------
    InputError
        If gwcs is not installed, or as `wcs.sip` does.
    """
    sky = known_sky(calibration)
    _, gwcs = _packages()
    export = sip(calibration, degree)
    header = export.header
    reference = [header[f"CRPIX{k}"] - 1.0 for k in (1, 2)]
    cd = np.array([[header[f"CD{k}_{m}"] for m in (1, 2)] for k in (1, 2)])
    bend = _polynomials(header, "A", "B")
    bend.inverse = _polynomials(header, "AP", "BP")
    turn = models.RotateNative2Celestial(sky.ra, sky.dec, 180.0)
    shift = models.Shift(-reference[0]) & models.Shift(-reference[1])
    plane = models.AffineTransformation2D(cd)
    transform = shift | bend | plane | models.Pix2Sky_TAN() | turn
    rows, columns = calibration.detector.shape
    frames = gwcs.coordinate_frames
    detector = frames.Frame2D(name="detector", axes_order=(0, 1), unit=(units.pix, units.pix))
    world = frames.CelestialFrame(name="icrs", reference_frame=ICRS(), unit=(units.deg, units.deg))
    wcs = gwcs.WCS([(detector, transform), (world, None)])
    # without a bounding box: gwcs would hold directions against a rectangle in RA and Dec around
    # the frame's corners, and give NaN for parts of a frame near a pole
    wcs.pixel_shape = columns, rows
    pixels = nodes(calibration.detector.shape, even=True)
    (true,) = objects(calibration, pixels, draws=False)
    found, binning = np.array(sky.to_plane(*wcs(*pixels))), calibration.detector.binning
    back = np.array(wcs.backward_transform(*sky.to_sky(*true)))
    return GeneralizedWCS(
        wcs,
        export.draws,
        truncation(found / binning, true / binning),
        truncation(back, pixels),
    )


def _polynomials(header: Any, *letters: str) -> Model:
    """The pair of polynomials of a header: those of the pixel itself, plus its distortion."""
    pair = []
    for k, letter in enumerate(letters):
        degree = header[f"{letter}_ORDER"]
        keys = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        values = {(i, j): header.get(f"{letter}_{i}_{j}", 0.0) for i, j in keys}
        values[1 - k, k] += 1.0
        named = {f"c{i}_{j}": value for (i, j), value in values.items()}
        pair.append(models.Polynomial2D(degree, **named))
    return models.Mapping((0, 1, 0, 1)) | pair[0] & pair[1]


def _packages() -> tuple[Any, Any]:
    try:
        import asdf  # noqa: PLC0415 - optional dependencies
        import asdf_astropy  # noqa: F401, PLC0415
        import gwcs  # noqa: PLC0415
    except ImportError:
        raise InputError(
            "gwcs or asdf-astropy is not installed, expected both: pip install 'bayesfred[gwcs]'"
        ) from None
    return asdf, gwcs

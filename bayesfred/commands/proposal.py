"""A run file proposed for a frame: what its noise, its header and its peaks say.

Gain, pedestal and read noise are those of `analysis.photon_transfer`, with their errors in comments
beside what the header says. The rest is a start that fits most calibration frames.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesfred._typing import Floats, PathLike
from bayesfred.analysis.photon_transfer import PhotonTransfer, photon_transfer
from bayesfred.errors import InputError, printable
from bayesfred.io.atomic import replace
from bayesfred.io.fits_images import StoredImage
from bayesfred.io.frames import read_stored
from bayesfred.io.headers import noise_in, units
from bayesfred.io.paths import may_write
from bayesfred.io.saturation import plateau
from bayesfred.optimize.image_widths import START, OutwardWidths, image_widths, outward_widths
from bayesfred.optimize.measure_psf import EACH, NODES
from bayesfred.settings.sections import toml_text

FOOTPRINT, LEAST_FOOTPRINT = 4.5, 5.0  # widths that an image reaches, and pixels
KNOWN = 3.0  # standard deviations of a read noise that is worth a key

TEXT = """\
# Proposed by `bayesfred init` for {name}: look at every line.
# `bayesfred fit --help` shows all keys.

[frame]
path = {path}
{frame}reject_outliers = true  # hot spots, and sources that have no image or do not fit

[catalogue]
path = {catalogue}  # columns x, y: pixels from the frame's middle; fluxes are free

[detector]
pixel = "box"

[psf]
kind = "measured"  # on the frame's own sources
sigma = {sigma:.2g}  # pixels, a start: by the brightest peaks
{varying}

[distortion]
terms = "polynomial"
degree = 3  # 9 terms a coordinate: 2 where there are fewer than some 12 sources

[noise]
{noise}
[nuisances]
flux = "free"
offset = true
model_error = true  # what the measured PSF leaves, as a share of the light
# position_scatter = true  # where the catalogue's positions are no better than the images'
background_order = 2
footprint = {footprint}  # pixels around each image: light farther out may be anything
"""


@dataclass(frozen=True)
class Proposed:
    """A run file that was proposed.

    Attributes
    ----------
    path : Path
        Of the run file.
    message : str
        What the noise of the frame says.
    """

    path: Path
    message: str


def init(
    frame: PathLike,
    second: PathLike | None = None,
    *,
    out: PathLike | None = None,
    overwrite: bool = False,
) -> Proposed:
    """Write a run file for a frame, with gain, pedestal and read noise by photon transfer.

    Parameters
    ----------
    frame : path-like
        As `fit` reads it.
    second : path-like, optional
        Another frame of the same scene and exposure, which tells the read noise.
    out : path-like, optional
        The run file; by default named after the frame, in the folder that this is started in.
    overwrite : bool
        Replace it.

    Returns
    -------
    Proposed

    Raises
    ------
    InputError
        If a frame cannot be read, or the run file exists.
    """
    frame = Path(frame)
    stem = frame.name.split(".")[0]
    path = Path(f"{stem}.toml" if out is None else out)
    if path.suffix != ".toml":
        raise InputError(f"{path}: got a run file of this name, expected one ending in .toml")
    may_write(path, overwrite=overwrite, inputs=[frame, *([] if second is None else [second])])
    image = read_stored(frame)
    others = [image] if second is None else [image, read_stored(Path(second))]
    used = [_masked(each) for each in others]
    try:
        found: PhotonTransfer | None = photon_transfer(*used)
        message = found.message if found else ""
    except InputError as error:
        found, message = None, str(error)
    keys, noise = _frame_keys(found, message, image)
    light = used[0]
    level = plateau(light[np.isfinite(light)])
    if level is not None:
        keys += f"saturation = {level!r}  # suspected: a plateau at the maximum\n"
        light = np.where(light < level, light, np.nan)
    widths = image_widths(light)
    sigma = START if widths is None else widths.typical
    varying = _varying(outward_widths(light, sigma))
    text = TEXT.format(
        name=printable(frame.name), path=toml_text(str(frame)), frame=keys, noise=noise,
        catalogue=toml_text(f"{stem}.csv"), sigma=sigma, varying=varying,
        footprint=max(LEAST_FOOTPRINT, round(FOOTPRINT * sigma) + 2.0),
    )  # fmt: skip
    replace(path, text.encode())
    return Proposed(path, message)


def _varying(widths: OutwardWidths | None) -> str:
    """The line of [psf] that lets it vary over the field."""
    if widths is None:
        return (
            "# degree = 1  # where the PSF varies over the field; of hundreds of sources nodes = 7 "
            "instead"
        )
    key = f"nodes = {NODES}" if widths.number > EACH * NODES**2 else "degree = 2"
    middle, outside = (f"{width:.2f}" for width in (widths.middle, widths.outside))
    return f"{key}  # images are {middle} pixels wide in the middle, {outside} outside"


def _masked(image: StoredImage) -> Floats:
    """The stored numbers, nan where they are flagged."""
    bad = ~np.isfinite(image.stored)
    for flags in image.flags.values():
        bad |= flags
    return np.where(bad, np.nan, image.stored)


def _frame_keys(found: PhotonTransfer | None, message: str, image: StoredImage) -> tuple[str, str]:
    """Lines of [frame] and of [noise]."""
    said, read_noise = noise_in(image.header)
    comment = f"; {said}" if said else ""
    if found is None:
        return f"# gain =   # e-/adu: {message}{comment}\n", "# read_noise =   # e-\n"
    errors = f"+- {found.gain_sd:.2g} by the frame's noise{comment}"
    level, level_sd, why = found.zero_level, found.zero_level_sd, "where the noise vanishes"
    by = "taken as part of the pedestal"
    if found.frames == 2 and found.read_noise > KNOWN * found.read_noise_sd:
        read_noise, by = found.read_noise, f"+- {found.read_noise_sd:.2g} by two frames"
    elif read_noise:
        by = "by the header"
    if read_noise:
        level, why = level + read_noise**2 / found.gain, "for the read noise below"
    gain = f"gain = {found.gain:.5g}  # e-/adu, {errors}\n"
    if units(image.header) == "electrons":
        gain = f"# gain: none, as BUNIT is electrons; {found.gain:.5g} {errors}\n"
    pedestal = f"pedestal = {level:.6g}  # stored units, +- {level_sd:.2g}: {why}\n"
    return gain + pedestal, f"read_noise = {read_noise or 0.0:#.4g}  # e-, {by}\n"

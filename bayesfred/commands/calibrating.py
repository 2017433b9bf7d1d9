"""Commands that hand a calibration over, and use it."""

from pathlib import Path
from typing import Any

import numpy as np

from bayesfred._typing import PathLike
from bayesfred.analysis.diagnostics import diagnose
from bayesfred.analysis.field import hull_of
from bayesfred.calibration.calibration import Calibration
from bayesfred.calibration.correct import correct as correct_frame
from bayesfred.calibration.corrected import read_cards, read_grid
from bayesfred.calibration.generalized_wcs import generalized_wcs
from bayesfred.calibration.maps import write_maps
from bayesfred.calibration.opencv import opencv_camera, write_opencv
from bayesfred.calibration.plate import Truncation
from bayesfred.calibration.regions import write_regions
from bayesfred.calibration.wcs import sip, tpv
from bayesfred.commands.records import Calibrated, Corrected
from bayesfred.commands.results import Say
from bayesfred.errors import InputError, printable
from bayesfred.io import atomic, outputs, paths
from bayesfred.io.frames import read_frame
from bayesfred.model.joint import JointPosterior
from bayesfred.reporting.calibration import STEPS, calibration_plot
from bayesfred.reporting.style import png
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.progress import working

__all__ = ["FORMATS", "calibration", "correct"]

# What each format's file is called, and the suffix that it must have.
FORMATS = {
    "sip": ("header", ".fits"), "tpv": ("header", ".fits"), "gwcs": ("gwcs", ".asdf"),
    "opencv": ("camera", ".json"), "regions": ("regions", ".reg"),
}  # fmt: skip


def calibration(
    chain_file: PathLike,
    *,
    form: str | None = None,
    degree: int = 3,
    focal_length: float | None = None,
    frame: str | None = None,
    out: PathLike | None = None,
    overwrite: bool = False,
    say: Say | None = None,
) -> Calibrated:
    """Write the calibration of a chain, with maps and a picture; or in the format of another tool.

    Parameters
    ----------
    chain_file : path-like
    form : {"sip", "tpv", "gwcs", "opencv", "regions"}, optional
        A format of another tool, in place of the calibration's own file with its maps and picture.
    degree : int
        Of the polynomials of a header or a gwcs.
    focal_length : float, optional, recorded pixel
        For OpenCV, where the object plane has no place on the sky.
    frame : str, optional
        Which of several frames: they share the lens and differ in where they point.
    out : path-like, optional
        The file; by default beside the chain, and maps and picture beside it.
    overwrite : bool
        Replace what is there.
    say : callable, optional
        Without it no progress is shown.

    Returns
    -------
    Calibrated

    Raises
    ------
    InputError
        If the chain is missing, damaged or of no frame; a file exists or has another suffix than
        its format's; or the format cannot hold such a calibration.
    """
    chain_file = Path(chain_file)
    label, suffix = FORMATS[form] if form else ("calibration", ".calibration.h5")
    chain = _chain_of(chain_file, frame)
    named = chain_file if frame is None else outputs.of_frame(chain_file, frame)
    path = named.with_suffix(suffix) if out is None else Path(out)
    ending = f".{suffix.rpartition('.')[2]}"
    if path.suffix != ending:
        raise InputError(f"{path}: got a file ending in {path.suffix!r}, expected {ending}")
    maps, picture = (path.with_suffix(s) for s in (".fits", ".png"))
    beside = () if form else (maps, picture)
    paths.may_write(path, overwrite=overwrite, beside=beside, inputs=(chain_file,))
    with working("judging the fit", show=say is not None):
        known = Calibration.from_chain(chain)
    if form is None:
        step = max(known.detector.fine_shape) / STEPS
        known.write(path, overwrite=overwrite)
        write_maps(known, maps, step, overwrite=overwrite)
        figure = calibration_plot(
            known, known.displacement_map(step), known.psf_map(step), hull_of(known.sources)
        )
        paths.may_write(picture, overwrite=overwrite)
        atomic.replace(picture, png(figure, 150))
        return Calibrated(known, {label: path, "maps": maps, "picture": picture})
    lines = _export(chain, known, form, path, (degree, focal_length, overwrite))
    return Calibrated(known, {label: path}, lines)


def _chain_of(chain_file: Path, frame: str | None) -> Chain:
    """The chain of a frame; of several frames, that of the one that is named."""
    chain = open_chain(chain_file)
    posterior = chain.posterior()
    if not isinstance(posterior, JointPosterior):
        if frame is not None:
            raise InputError(f"{chain_file}: got --frame {frame}, expected none: it has one frame")
        return chain
    if frame is None or frame not in posterior.frames:
        got = "no --frame" if frame is None else f"--frame {printable(frame)}"
        raise InputError(
            f"{chain_file}: got {got}, expected one of its frames: {', '.join(posterior.frames)}"
        )
    return chain.frame(frame)


def _export(
    chain: Chain, known: Calibration, form: str, path: Path, how: tuple[int, float | None, bool]
) -> tuple[str, ...]:
    """Write one format; what is to be known of it."""
    degree, focal_length, overwrite = how
    if form == "regions":
        write_regions(path, diagnose(chain).sources, known.detector.shape, overwrite=overwrite)
        return ("arrows: the counts say that a source is off the model, 100 times enlarged",)
    if form == "opencv":
        camera = opencv_camera(known, focal_length=focal_length)
        write_opencv(path, camera, overwrite=overwrite)
        rms, largest = (camera["truncation_error_px"][key] for key in ("rms", "max"))
        return (_error("OpenCV's camera", Truncation(rms, largest)),)
    make: Any = {"sip": sip, "tpv": tpv, "gwcs": generalized_wcs}[form]
    export = make(known, degree)
    export.write(path, overwrite=overwrite)
    return _error("pixel to sky", export.forward), _error("sky to pixel", export.inverse)


def _error(what: str, error: Truncation) -> str:
    return (
        f"truncation error of {what}: {error.rms:.2g} px rms, {error.largest:.2g} px at worst, "
        "over the whole frame"
    )


def correct(
    frame: PathLike,
    calibration: PathLike,
    *,
    out: PathLike,
    like: PathLike | None = None,
    gain: float | None = None,
    pedestal: float | None = None,
    overwrite: bool = False,
) -> Corrected:
    """Resample a frame to undistorted coordinates, and write it with its errors as FITS.

    Parameters
    ----------
    frame : path-like
        See `bayesfred.io.frames.read_frame`, also for `gain` and `pedestal`.
    calibration : path-like
        A calibration's file.
    out : path-like
        The FITS file.
    like : path-like, optional
        A FITS file on whose pixels the frame is put.
    gain : float, optional, e-/adu
    pedestal : float, optional, stored units
    overwrite : bool
        Replace `out`.

    Returns
    -------
    Corrected
        The variance is that of Poisson counts, and of the read noise if the header has it.

    Raises
    ------
    InputError
        If a file is unusable, or `out` exists or is one that is read.
    """
    path = Path(out)
    if path.suffix.lower() not in (".fits", ".fit", ".fts"):
        raise InputError(f"{path}: got a file ending in {path.suffix!r}, expected .fits")
    inputs = [frame, calibration, *([] if like is None else [like])]
    paths.may_write(path, overwrite=overwrite, inputs=inputs)
    known = Calibration.read(calibration)
    record = read_frame(frame, gain=gain, pedestal=pedestal)
    wcs, shape = (None, None) if like is None else read_grid(like)
    corrected = correct_frame(
        record.counts,
        known,
        wcs=wcs,
        shape=shape,
        variance=np.maximum(record.counts, 1.0) + (record.read_noise or 0.0) ** 2,
        mask=record.valid,
    )
    corrected.write(path, header=read_cards(frame), overwrite=overwrite)
    return Corrected(corrected, record.description, path)

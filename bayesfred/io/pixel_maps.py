"""Maps of a detector's pixels: gain, flat field and read-out variance, applied to a frame.

    counts = (stored - pedestal) * gain / flat

A pixel of which a map says nothing, because it is not a positive number, is masked.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bayesfred._typing import Flags, Floats, PathLike
from bayesfred.errors import InputError, printable
from bayesfred.io.frames import FrameRecord, read_frame, read_stored

__all__ = ["PixelMaps", "read_mapped_frame", "read_maps"]

# What counts as a measurement: the least and the largest number, and its unit.
RANGES = {
    "gain": (1e-6, 1e6, "e-/adu"),
    "flat": (0.01, 100.0, "relative response"),
    "variance": (1e-4, 1e12, "e-^2"),
}


@dataclass(frozen=True, eq=False)
class PixelMaps:
    """Maps of the pixels of one detector; None where there is none.

    Attributes
    ----------
    gain : ndarray, shape (ny, nx), or None, e-/adu
    flat : ndarray, shape (ny, nx), or None
        Relative response.
    variance : ndarray, shape (ny, nx), or None, e-^2
        Of the read-out.
    valid : ndarray of bool, shape (ny, nx), or None
        Where all maps have positive numbers. Elsewhere they are 1.
    description : str
        The files, and how many pixels they mask.
    """

    gain: Floats | None = None
    flat: Floats | None = None
    variance: Floats | None = None
    valid: Flags | None = None
    description: str = ""

    @property
    def read_noise(self) -> Floats | None:
        """Standard deviation of the read-out, e-."""
        return None if self.variance is None else np.sqrt(self.variance)


def read_maps(paths: Mapping[str, PathLike]) -> PixelMaps:
    """Read maps of one detector.

    Parameters
    ----------
    paths : mapping of str to path-like
        Files as `read_frame` takes them, by the name of the map: `gain`, `flat` or `variance`.

    Returns
    -------
    PixelMaps

    Raises
    ------
    InputError
        A file cannot be read; maps differ in shape; no pixel is usable; a flat field is not
        relative to 1.

    Examples
    --------
    >>> import tempfile
    >>> from bayesfred.io.frames import write_frame
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_frame(f"{folder}/flat.fits", [[0.9, 0.0], [1.2, 1.0]])
    ...     maps = read_maps({"flat": f"{folder}/flat.fits"})
    >>> maps.description, maps.valid.tolist()
    ('flat by flat.fits, 1 pixel masked', [[True, False], [True, True]])
    """
    found: dict[str, Any] = {}
    said, valid = [], None
    for name, given in paths.items():
        path, (least, most, unit) = Path(given), RANGES[name]
        values = read_stored(path).stored
        if valid is not None and values.shape != valid.shape:
            raise InputError(
                f"{path}: {name}: got shape {values.shape}, expected {valid.shape}, that of the "
                "other maps"
            )
        good = (values >= least) & (values <= most)  # false for NaN
        middle = float(np.median(values[good])) if good.any() else float("nan")
        if not good.any() or (name == "flat" and not 0.5 <= middle <= 2.0):
            got = f"a median of {middle:.3g}" if good.any() else "no such pixel"
            remedy = "divide it by its median" if name == "flat" else "check the file and its unit"
            raise InputError(
                f"{path}: {name}: got {got}, expected numbers from {least:g} to {most:g} ({unit}"
                f"{', about 1' if name == 'flat' else ''}): {remedy}"
            )
        bad = int((~good).sum())
        masked = f", {bad} pixel{'s' * (bad > 1)} masked" if bad else ""
        said.append(f"{name} by {printable(path.name)}{masked}")
        found[name] = np.where(good, values, 1.0)
        valid = good if valid is None else valid & good
    return PixelMaps(**found, valid=valid, description="; ".join(said))


def read_mapped_frame(
    path: PathLike, maps: PixelMaps, *, gain: float | None = None, **keywords: Any
) -> FrameRecord:
    """Read a frame and apply maps of its pixels.

    Parameters
    ----------
    path : path-like
    maps : PixelMaps
    gain : float, optional, e-/adu
        Where there is no map of it.
    **keywords
        Those of `read_frame`.

    Returns
    -------
    FrameRecord
        Its counts are divided by the flat field, if there is one.

    Raises
    ------
    InputError
        As `read_frame` does; or a map's shape is not the frame's, or no pixel is left.
    """
    if maps.valid is None:
        return read_frame(path, gain=gain, **keywords)
    if maps.gain is not None:
        gain = float(np.median(maps.gain[maps.valid]))
    frame = read_frame(path, gain=gain, **keywords)
    if maps.valid.shape != frame.counts.shape:
        raise InputError(
            f"{path}: got shape {frame.counts.shape}, expected {maps.valid.shape}, that of "
            f"{maps.description}: cut maps and frame alike"
        )
    valid = frame.valid & maps.valid
    if not valid.any():
        raise InputError(
            f"{path}: got every pixel masked by the frame or by {maps.description}, expected some "
            "to use"
        )
    counts = frame.counts
    if maps.gain is not None and gain is not None:
        counts = counts * (maps.gain / gain)
    if maps.flat is not None:
        counts = counts / maps.flat
    return replace(
        frame,
        counts=np.where(valid, counts, 0.0),
        valid=valid,
        n_masked=int(valid.size - valid.sum()),
        description=f"{frame.description}; {maps.description}",
    )

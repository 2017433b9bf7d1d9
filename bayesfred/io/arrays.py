"""Frames that say more than their numbers: masked arrays, quantities, `CCDData`.

Masks and units are honoured and uncertainties held against the noise model; what cannot be honoured
is refused. None is dropped, as `numpy.asarray` would. The objects are told by their attributes, so
that nothing of astropy is loaded for a frame that is a plain array.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError

__all__ = ["frame_given", "stored_values"]

UNITS = ("electron", "photon", "ct", "")
VARIANCE_POWER = {"std": 2.0, "var": 1.0, "ivar": -1.0}


def frame_given(
    counts: Any, mask: npt.ArrayLike | None = None, variance: Any = None
) -> tuple[Floats, Flags | None]:
    """The numbers of a frame in counts, and the pixels to use.

    Parameters
    ----------
    counts : array_like, MaskedArray, Quantity, NDData or CCDData, shape (ny, nx)
        A unit has to be electrons, photons or counts.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is to be used.
    variance : float or ndarray, optional, counts^2
        That of the noise model, where it has one.

    Returns
    -------
    counts : ndarray, shape (ny, nx), counts
        nan in pixels that the frame itself masks. That of a file mapped into memory is not
        copied, if it has whole numbers or float64.
    mask : ndarray of bool, shape (ny, nx), or None
        True where a pixel is to be used, by `mask` and by the frame.

    Raises
    ------
    InputError
        The unit is another one, the uncertainty is not that of the noise model, or there are flags.

    Examples
    --------
    >>> frame_given(np.ma.masked_equal([[3.0, -1.0]], -1.0))
    (array([[ 3., nan]]), array([[ True, False]]))
    """
    if isinstance(counts, np.memmap) and (counts.dtype.kind in "ui" or counts.dtype == np.float64):
        # read where it is needed: a large frame would not fit the memory once more; arithmetic with
        # numbers of these types is that of float64, which float32 would not be
        return np.asarray(counts), None if mask is None else np.array(mask, dtype=bool)
    if getattr(counts, "flags", None) is not None and hasattr(counts, "uncertainty"):
        raise InputError("counts: got a frame with flags, expected a mask: set mask, not flags")
    factor = _electrons(getattr(counts, "unit", None))
    uncertainty = getattr(counts, "uncertainty", None)
    values, bad = _parts(counts)
    values *= factor
    if bad is not None:
        values[bad] = np.nan
        used = ~bad if mask is None else np.asarray(mask, dtype=bool)
        mask = used & ~bad if used.shape == bad.shape else used  # shapes are checked elsewhere
    if uncertainty is not None:
        _require_variance(uncertainty, factor, values, variance)
    return values, None if mask is None else np.array(mask, dtype=bool)


def stored_values(frame: Any) -> Floats:
    """The numbers of a frame in its own unit, nan in pixels that it masks, shape (ny, nx)."""
    values, bad = _parts(frame)
    if bad is not None:
        values[bad] = np.nan
    return values


def _parts(frame: Any) -> tuple[Floats, Flags | None]:
    """A copy of a frame's numbers, and the pixels that it masks, if any."""
    data = frame.data if hasattr(frame, "uncertainty") else getattr(frame, "unmasked", frame)
    values = np.array(getattr(data, "value", data), dtype=np.float64)
    mask = getattr(frame, "mask", None)
    if mask is None or callable(mask) or not np.any(mask):
        return values, None
    return values, np.broadcast_to(np.asarray(mask, dtype=bool), values.shape)


def _electrons(unit: Any) -> float:
    """Counts in one of a unit."""
    if unit is None:
        return 1.0
    for name in UNITS:
        if unit.is_equivalent(name):
            return float(unit.to(name))
    raise InputError(
        f"counts: got a frame in {unit}, expected electrons, photons or counts: convert it, with "
        "the gain (e-/adu) and the pedestal if it is in adu"
    )


def _require_variance(uncertainty: Any, factor: float, values: Floats, variance: Any) -> None:
    """Refuse uncertainties that the noise model does not have."""
    power = VARIANCE_POWER.get(uncertainty.uncertainty_type)
    used = np.isfinite(values)
    if power is not None and variance is not None:
        with np.errstate(divide="ignore"):
            told = factor**2 * np.asarray(uncertainty.array, dtype=np.float64) ** power
        model = np.broadcast_to(variance, values.shape)
        if np.allclose(told[used], model[used], rtol=1e-6, atol=0.0):
            return
    raise InputError(
        "counts: got a frame with uncertainties, expected a noise model that has them: give noise "
        "= bf.GaussianNoise(variance) with their squares, or set the frame's uncertainty to None"
    )

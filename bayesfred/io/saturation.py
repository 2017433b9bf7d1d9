"""Saturation suspected from a frame alone: a plateau at its maximum.

Stored numbers come in steps, and their density falls towards the maximum M or is flat there: a
star's profile passes through all levels up to its peak. Of the pixels in the w levels below M and
at it, each then lies at M with a probability of at most 1/w. So beside the one that makes M the
maximum, n others in these levels put more than k at M with at most the binomial probability, and
where that is tiny, the levels end at M because the detector does.
"""

from pathlib import Path

import numpy as np
from scipy.special import bdtrc

from bayesfred._typing import Floats
from bayesfred.errors import InputError

__all__ = ["plateau", "suspicion"]

MOST_SATURATED = 0.5  # share of the pixels
CHANCE = 1e-3  # of suspecting a frame without saturated pixels, at most
TOP = 0.1  # share of the range, from the median to the maximum, that is compared with the maximum
# Of 12, 14, 15 and 16 bits, and of 12 and 14 bits in the upper ones of 16: one pixel is suspect.
FULL_SCALE = (4095.0, 16383.0, 32767.0, 65535.0, 65520.0, 65532.0)
SAMPLE = 10**5  # pixels in which the steps are looked for


def plateau(stored: Floats, largest: float | None = None) -> float | None:
    """The level at which pixels look saturated; None where none do.

    Parameters
    ----------
    stored : ndarray, shape (n,), stored units; finite
    largest : float, optional
        The largest number that the file could hold: one pixel there is suspect.

    Returns
    -------
    float or None, stored units

    Examples
    --------
    >>> counts = np.random.default_rng(1).poisson(10.0 + 3000.0 * np.linspace(0.0, 1.0, 1000) ** 9)
    >>> plateau(counts), plateau(np.minimum(counts, 2500))
    (None, 2500.0)
    """
    if not stored.size:
        return None
    top = float(stored.max())
    if top in FULL_SCALE or top == largest:
        return top
    with np.errstate(over="ignore"):
        steps = np.diff(np.unique(stored[:: max(1, stored.size // SAMPLE)]))
    if not steps.size:
        return None
    # infinite where steps are as small as floats can be
    levels = np.floor(TOP * (top - float(np.median(stored))) / float(steps.min()))
    if levels < 2:
        return None
    others = int(np.sum(stored > top - levels * steps.min())) - 1
    more = int(np.sum(stored == top)) - 1
    if more and bdtrc(more - 1, others, 1.0 / levels) < CHANCE:
        return top
    return None


def suspicion(path: Path, level: float, share: float) -> str:
    """The line on pixels that seem saturated.

    Parameters
    ----------
    path : Path
    level : float, stored units
    share : float
        Of the pixels.

    Returns
    -------
    str

    Raises
    ------
    InputError
        If half of the pixels are, which no fit can use.
    """
    if share > MOST_SATURATED:
        raise InputError(
            f"{path}: got {share:.0%} of the pixels at the maximum of {level:.9g}, expected a "
            "frame that is not saturated: expose it less, or give saturation if it is not"
        )
    return (
        f"saturation suspected at the maximum of {level:.9g}: give a higher saturation if that is "
        "wrong"
    )

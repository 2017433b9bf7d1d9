"""By how much a chain says that an object is displaced: what a distortion is measured for.

The displacement of the object that is imaged at (u, v) is (u - x, v - y), with x and y the root of

    u - x + f(u, v, x, y) = offset_x,    v - y + g(u, v, x, y) = offset_y.

It is solved for every draw, so that mean and covariance are those of the posterior itself, however
the displacement depends on the coefficients. `imaging.inverse` finds the roots.
"""

from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.joint import JointPosterior
from bayesfred.model.parameters import displacing
from bayesfred.model.posterior import Posterior

if TYPE_CHECKING:
    from bayesfred.sampling.chain import Chain

__all__ = ["displacement", "frame_posterior", "spread_draws"]

# A standard deviation of this many independent draws has an error of 2.2 %, a variance of 4.5 %.
MOST_DRAWS = 1000
BLOCK = 2**18  # roots that are kept at once


def displacement(chain: "Chain", u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[Floats, Floats]:
    """Mean and covariance of the displacement of the objects that are imaged at (u, v).

    Parameters
    ----------
    chain : Chain
        Of a frame. Its draws after burn-in are used; if there are more than 1,000, one of each of
        1,000 blocks of successive draws. Of 1,000 independent draws a standard deviation has a
        Monte Carlo error of 2.2 %, and the mean one of 3 % of the standard deviation.
    u, v : array_like, pixel of the fine grid
        Image points from the middle of the frame, broadcast against each other.

    Returns
    -------
    mean : ndarray, shape (..., 2), pixel of the fine grid
        u - x and v - y, the pointing's offset included, after the shape of the points. NaN where no
        object is imaged according to a draw.
    covariance : ndarray, shape (..., 2, 2), pixel^2
        Of the posterior: it omits errors of the catalogue, the PSF and the model itself.

    Raises
    ------
    InputError
        If the chain is of a density that is no frame's, or the points cannot be broadcast.
    """
    posterior = frame_posterior(chain)
    try:
        u, v = np.broadcast_arrays(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64))
    except (TypeError, ValueError):
        raise InputError(
            f"u, v: got {np.shape(u)} and {np.shape(v)}, expected numbers that can be broadcast "
            "against each other"
        ) from None
    draws = spread_draws(chain)
    theta, offset = displacing(posterior.parameters, draws)
    points = np.stack([u.ravel(), v.ravel()])
    mean, covariance = np.empty((points.shape[1], 2)), np.empty((points.shape[1], 2, 2))
    size = max(1, BLOCK // len(draws))
    for first in range(0, points.shape[1], size):
        some = slice(first, first + size)
        at = points[:, None, some]
        found = at - posterior.model.polynomial.object_position(theta, *at[:, 0], offset=offset)
        mean[some] = found.mean(axis=1).T
        off = found - found.mean(axis=1, keepdims=True)
        covariance[some] = np.einsum("inp,jnp->pij", off, off) / (len(draws) - 1)
    return mean.reshape(*u.shape, 2), covariance.reshape(*u.shape, 2, 2)


def spread_draws(chain: "Chain") -> Floats:
    """At most 1,000 of a chain's draws after burn-in, spread over it.

    Parameters
    ----------
    chain : Chain

    Returns
    -------
    ndarray, shape (n, d), parameter units
    """
    draws = chain.draws()
    if len(draws) <= MOST_DRAWS:
        return draws
    # at random within each block, as walkers stand in turn
    part = (np.arange(MOST_DRAWS) + np.random.default_rng(0).random(MOST_DRAWS)) / MOST_DRAWS
    return np.asarray(draws[(part * len(draws)).astype(int)])


def frame_posterior(chain: "Chain") -> Posterior:
    """The posterior of a chain, if it is that of a frame.

    Parameters
    ----------
    chain : Chain

    Returns
    -------
    Posterior

    Raises
    ------
    InputError
        If it is another density.
    """
    posterior = chain.posterior()
    if isinstance(posterior, JointPosterior):
        names = list(posterior.frames)
        raise InputError(
            f"chain: got one of the frames {', '.join(names[:5])}{', ...' * (len(names) > 5)}, "
            f'expected that of a frame: chain.frame("{names[0]}")'
        )
    if not hasattr(posterior, "model"):
        raise InputError(
            "chain: displacement: got draws of a density that is no frame's, expected those of a "
            "Posterior"
        )
    return cast(Posterior, posterior)

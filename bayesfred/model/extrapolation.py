"""Where fluxes and shifts have their maximum, extrapolated from one parameter vector.

The most likely ones are a smooth function of the other parameters. Within a posterior's width it is
nearly linear: what its secants leave is little enough for one Newton step of fluxes, see
`kernels/extrapolate.py`, and for two or three of fluxes and shifts, see
`kernels/shift_newton.py`.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.forward import ForwardModel
from bayesfred.model.buffers import new_turns
from bayesfred.model.kernels.contexts import Clusters, Nearby, Rendered, Turns
from bayesfred.model.kernels.evaluate import extrapolated_log_likelihoods, log_likelihoods
from bayesfred.model.kernels.extrapolate import Extrapolated, describe
from bayesfred.model.near_mean import FARTHER, whitening

LEAST = 0.1  # of a flux nearby, that it is taken to have at least


class FluxExtrapolation(NamedTuple):
    """Most likely fluxes as a linear function of the parameters, and their Hessian H."""

    model: ForwardModel  # whose sources these are
    params: Floats  # (d,)
    fluxes: Floats  # (s,) there
    slope: Floats  # (s, d)
    clusters: Clusters
    hessian: tuple[Ints, Ints, Ints, Ints, Ints, Floats]  # see `Extrapolated`

    def at(self, vectors: Floats) -> Extrapolated:
        """For parameter vectors of shape (n, d)."""
        # not `@`, whose bits depend on n
        moved = np.einsum("nd,sd->ns", vectors - self.params, self.slope)
        return Extrapolated(self.fluxes + moved, self.clusters, *self.hessian)

    def work(self, vectors: Floats, out: Floats) -> tuple[Callable[..., Any], Turns]:
        """What evaluates log-likelihoods of vectors into `out`; it leaves NaN where it fails."""
        kernel = partial(extrapolated_log_likelihoods, extrapolated=self.at(vectors))
        return kernel, new_turns(out)


class ShiftExtrapolation(NamedTuple):
    """Most likely fluxes and shifts as a linear function of the parameters."""

    model: ForwardModel  # whose sources these are
    params: Floats  # (d,)
    whitened: Floats  # (d, d) times a vector less `params`: in standard deviations
    found: Floats  # (s, 3) there
    slope: Floats  # (s, 3, d)
    nearby: Nearby

    def work(self, vectors: Floats, out: Floats) -> tuple[Callable[..., Any], Turns]:
        """What evaluates log-likelihoods of vectors into `out`; NaN where they are far away."""
        moved = vectors - self.params
        distance = np.sqrt(np.sum(np.einsum("nd,kd->nk", moved, self.whitened) ** 2, axis=1))
        out[(distance > math.sqrt(self.params.size) + FARTHER) & (out > -np.inf)] = np.nan
        start = self.found + np.einsum("nd,std->nst", moved, self.slope)
        start[..., 0] = np.maximum(start[..., 0], LEAST * self.found[:, 0])
        return log_likelihoods, new_turns(out, start=start, nearby=self.nearby)


Extrapolation = FluxExtrapolation | ShiftExtrapolation


def extrapolate(
    model: ForwardModel,
    found_at: Callable[[Floats], Floats],
    rendered: Rendered,
    nearby: Nearby,
    around: tuple[Floats, Floats],
) -> Extrapolation | None:
    """From fluxes and shifts at some parameters and a standard deviation from them.

    That is along whitened axes. `around` are the parameters and a covariance. There is no
    extrapolation without one, or where the likelihood is zero. `found_at` gives fluxes and shifts
    of n vectors, shape (n, s, 3), NaN where the map folds or the background ends; there the other
    side of the axis serves, and where that has none they are taken as constant.
    """
    (params, covariance), profiled, fluxes = around, rendered.profiled, rendered.fluxes
    axes = whitening(covariance)
    if axes is None or not nearby.e.size:
        return None
    assert profiled is not None
    here = np.column_stack([fluxes, profiled.shifts])
    change = found_at(params + axes.T) - here
    if (none := np.isnan(change[:, 0, 0])).any():
        change[none] = here - found_at(params - axes.T[none])
    change = np.nan_to_num(change).reshape(len(axes), -1)
    slope = linalg.solve_triangular(axes, change, trans="T", lower=True).T
    if nearby.e.shape[1] == 1:
        by_flux, clusters = np.ascontiguousarray(slope[::3]), profiled.touching.clusters
        hessian = describe(profiled, fluxes, nearby.e[:, 0])
        return FluxExtrapolation(model, params, fluxes, by_flux, clusters, hessian)
    whitened = linalg.solve_triangular(axes, np.eye(len(axes)), lower=True)
    slope = np.ascontiguousarray(slope.reshape(len(here), 3, -1))
    return ShiftExtrapolation(model, params, whitened, here, slope, nearby)

"""Where free fluxes have their maximum, extrapolated from one parameter vector.

The most likely fluxes are a smooth function of the other parameters. Within a posterior's width it
is nearly linear: what its secants leave is little enough for one Newton step, see
`kernels/extrapolate.py`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import linalg

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.forward import ForwardModel
from bayesfred.model.kernels.contexts import Clusters, Rendered
from bayesfred.model.kernels.extrapolate import Extrapolated, describe
from bayesfred.model.near_mean import whitening


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


def flux_extrapolation(
    model: ForwardModel,
    fluxes_at: Callable[[Floats], Floats],
    rendered: Rendered,
    z: Floats,
    params: Floats,
    covariance: Floats,
) -> FluxExtrapolation | None:
    """From the fluxes at `params` and a standard deviation to either side along whitened axes.

    Along axes on which there are none, because the map folds or the background ends, they are taken
    as constant. z is that of `kernels/gradient.py`. Without a covariance there is no extrapolation.
    """
    axes = whitening(covariance)
    if axes is None:
        return None
    change = np.stack(
        [0.5 * (fluxes_at(params + axis) - fluxes_at(params - axis)) for axis in axes.T], axis=1
    )
    slope = linalg.solve_triangular(axes, np.nan_to_num(change).T, trans="T", lower=True).T
    profiled, fluxes = rendered.profiled, rendered.fluxes
    assert profiled is not None
    hessian = describe(profiled, fluxes, z)
    return FluxExtrapolation(model, params, fluxes, slope, profiled.touching.clusters, hessian)

r"""The observed information about the parameters that displace images.

The Fisher information is an expectation over data. Where some sources lie in the tails of the
scatter's distribution, or their residuals are not those of the model, the curvature of the
log-posterior differs from it, and not alike in all directions.

Where f and g depend on the object position alone they displace the image of source s as a whole, by
J_s theta. With l_s the slope of the log-likelihood by a displacement of that source, the curvature
by displacements common to all is h_s = -d l_s / d offset, shape (2, 2): differences of the slopes
between two offsets. Sources that overlap are displaced nearly alike. So

    H = sum_s J_s^T h_s J_s

is the observed information about the coefficients and the offset, for four gradients.

References
----------
B. Efron & D. V. Hinkley (1978), Biometrika 65, 457: observed and expected information.
"""

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.monomials import U, V
from bayesfred.model.likelihood import FrameLikelihood


def displacing_parameters(likelihood: FrameLikelihood) -> Ints:
    """The parameters whose observed information can be told; none where f and g move with u and v.

    Parameters
    ----------
    likelihood : FrameLikelihood

    Returns
    -------
    ndarray of int, shape (k,)
        The coefficients, then the offset.
    """
    field, parameters = likelihood.model.polynomial, likelihood.parameters
    whole = all(t[U] == t[V] == 0 for t in (*field.f_terms, *field.g_terms))
    if not (whole and likelihood.nuisances.offset):
        return np.empty(0, np.int64)
    moving = (each.kind == "distortion" or each.name.startswith("offset") for each in parameters)
    return np.flatnonzero(list(moving))


def observed_information(likelihood: FrameLikelihood, params: Floats, covariance: Floats) -> Floats:
    """The observed information of the likelihood about the `displacing_parameters`.

    Parameters
    ----------
    likelihood : FrameLikelihood
        Which has some.
    params : ndarray, shape (d,)
    covariance : ndarray, shape (k, k)
        Of these parameters: as far apart as draws displace the sources the slopes are taken.

    Returns
    -------
    ndarray, shape (k, k)
        NaN where the likelihood is zero at one of the offsets.
    """
    field, sources = likelihood.model.polynomial, likelihood.model.sources
    at_rest = np.zeros(len(sources))
    design = field.design_matrix(at_rest, at_rest, sources.x, sources.y)
    offset = np.broadcast_to(np.eye(2)[:, None], (2, len(sources), 2))
    moves = np.concatenate([-design, offset], axis=2)  # of every image, shape (2, s, k)
    typical = np.sqrt(np.mean(np.sum((moves @ covariance) * moves, axis=2), axis=1))
    basis = likelihood.model.basis(("offset_x", "offset_y"))
    curvature = np.empty((len(sources), 2, 2))
    for axis, k in enumerate(displacing_parameters(likelihood)[-2:]):
        step = np.zeros(params.size)
        step[k] = typical[axis]
        above, below = (
            likelihood.slopes(at, basis)[0][:, basis.row[-2:]]
            for at in (params + step, params - step)
        )
        curvature[:, :, axis] = (above - below) / (2.0 * typical[axis])  # the offset has a minus
    curvature = 0.5 * (curvature + curvature.transpose(0, 2, 1))
    return np.asarray(np.einsum("asj,sab,bsk->jk", moves, curvature, moves, optimize=True))

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
from bayesfred.model.posterior import Posterior


def displacing_parameters(posterior: Posterior) -> Ints:
    """The parameters whose observed information can be told; none where f and g move with u and v.

    Parameters
    ----------
    posterior : Posterior

    Returns
    -------
    ndarray of int
    """
    field, parameters = posterior.model.polynomial, posterior.parameters
    whole = all(t[U] == t[V] == 0 for t in (*field.f_terms, *field.g_terms))
    if not (whole and posterior.nuisances.offset):
        return np.empty(0, int)
    return np.array(
        [
            k
            for k, each in enumerate(parameters)
            if each.kind == "distortion" or each.name.startswith("offset")
        ]
    )


def observed_information(posterior: Posterior, params: Floats, information: Floats) -> Floats:
    """The information, with the observed one about the parameters that displace images.

    Parameters
    ----------
    posterior : Posterior
        Of which `displacing_parameters` names some.
    params : ndarray, shape (d,)
        Where it has a density.
    information : ndarray, shape (d, d)
        There, expected.

    Returns
    -------
    ndarray, shape (k, k)
        About these parameters alone, the others known, with the curvature of the prior.
    """
    which, likelihood = displacing_parameters(posterior), posterior.likelihood
    moves = _moves(posterior)[:, :, which]
    prior = posterior.prior_information(params)[np.ix_(which, which)]
    covariance = np.linalg.inv(information[np.ix_(which, which)])
    # as far apart as draws displace the sources
    typical = np.sqrt(np.einsum("asj,jk,ask->a", moves, covariance, moves) / moves.shape[1])
    basis = posterior.model.basis(("offset_x", "offset_y"))
    curvature = np.empty((len(posterior.model.sources), 2, 2))
    for axis, name in enumerate(("offset_x", "offset_y")):
        step = np.zeros(params.size)
        step[posterior.parameter_names.index(name)] = typical[axis]
        above, below = (
            likelihood.slopes(at, basis)[0][:, basis.row[-2:]]
            for at in (params + step, params - step)
        )
        curvature[:, :, axis] = (above - below) / (2.0 * typical[axis])  # the offset has a minus
    curvature = 0.5 * (curvature + curvature.transpose(0, 2, 1))
    found = np.einsum("asj,sab,bsk->jk", moves, curvature, moves, optimize=True)
    return np.asarray(found + prior)


def _moves(posterior: Posterior) -> Floats:
    """What the parameters do to the image of every source, shape (2, s, d)."""
    field, sources = posterior.model.polynomial, posterior.model.sources
    out = np.zeros((2, len(sources), posterior.n_parameters))
    zero = np.zeros(len(sources))
    design = field.design_matrix(zero, zero, sources.x, sources.y)
    for k, parameter in enumerate(posterior.parameters):
        if parameter.kind == "distortion":
            out[:, :, k] = -design[:, :, parameter.slot]
        elif parameter.name.startswith("offset"):
            out[("offset_x", "offset_y").index(parameter.name), :, k] = 1.0
    return out

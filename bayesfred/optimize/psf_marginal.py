"""What a posterior's parameters have in common with a PSF that was measured on the same frame.

The PSF's unknowns are integrated out by Laplace's approximation. Their information about the other
parameters tells what their errors add (`shared_information`), and the volume of their posterior
what the residuals lack (`occam_factor`).
"""

import math
from dataclasses import replace

import numpy as np
from scipy import spatial
from scipy.optimize import nnls

from bayesfred._typing import Flags, Floats
from bayesfred.model.posterior import Posterior
from bayesfred.model.psf_errors import OccamFactor
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.psf_equations import SEEN, PsfEquations, PsfInformation, PsfState, observed
from bayesfred.optimize.psf_nodes import NodeEquations
from bayesfred.optimize.psf_samples import PsfSamples

ERRORS = (0.5, 1.0, 2.0, 4.0)  # times the model error, at which the volume is computed
SCALES = 2.0 ** np.arange(-6.0, 5.0)  # times the model error, of which it is made


def shared_information(posterior: Posterior, state: PsfState, params: Floats) -> Floats:
    """The information that a PSF's deviations share with a posterior's parameters.

    Fluxes and shifts of single sources follow. The noise is the posterior's own, and no pixel
    counts less. As in all equations here, f and g change with a coefficient over a source's image
    as they do in its middle: that is exact where they do not depend on u and v.

    Parameters
    ----------
    posterior : Posterior
        With the PSF.
    state : PsfState
        Where the PSF was found.
    params : ndarray, shape (d,)
        Maximum of the posterior.

    Returns
    -------
    ndarray, shape (deviations, d)
    """
    # what the equations of a PSF leave out in the corners of the grids is part of the PSF
    levels = state.grid.levels
    corner = math.sqrt(0.5) * float(np.max((levels.side + 4) * levels.spacing))
    state = _at(posterior, state, params)
    data = PsfSamples.at(posterior, params, state.shifts, corner)
    found = _information(posterior, state, data, _model_error(posterior, params))
    size = state.deviations.size
    return np.asarray(found.matrix[size:, :size].T)


def node_slopes(posterior: Posterior, state: PsfState, params: Floats) -> Floats:
    """The covariance of the slopes that a PSF's errors at its nodes give a log-posterior.

    Parameters
    ----------
    posterior : Posterior
        With the PSF.
    state : PsfState
        Where the PSF was found, with nodes.
    params : ndarray, shape (d,)
        Maximum of the posterior.

    Returns
    -------
    ndarray, shape (d, d)
    """
    nodes = state.nodes
    assert nodes is not None, "the PSF varies between them"
    state = _at(posterior, state, params)
    with one_blas_thread():
        equations = _at_nodes(posterior, state, _model_error(posterior, params))
        return equations.covariance_of_slopes(nodes.strength)


def occam_factor(posterior: Posterior, state: PsfState, params: Floats) -> OccamFactor:
    """What the volume of a PSF's posterior says of the model error.

    Parameters
    ----------
    posterior : Posterior
        With the PSF and a model error.
    state : PsfState
        Where the PSF was found.
    params : ndarray, shape (d,)
        Maximum of the posterior.

    Returns
    -------
    OccamFactor
    """
    error = float(params[posterior.parameter_names.index("model_error")])
    state = _at(posterior, state, params)
    data = PsfSamples.at(posterior, params, state.shifts, state.grid.radius)
    errors = error * np.array([0.0, *ERRORS])
    with one_blas_thread():
        volumes = np.array([_log_volume(posterior, state, data, each) for each in errors])
    scales = error * SCALES
    terms = 0.5 * np.log1p((errors[1:, None] / scales) ** 2)
    return OccamFactor(nnls(terms, volumes[1:] - volumes[0])[0], scales)


def lit_pixels(posterior: Posterior, state: PsfState) -> Flags:
    """The pixels without those nearest to sources that show hardly any of their light.

    Where all but the wings of a source is masked, the noise would make any flux of them.

    Parameters
    ----------
    posterior : Posterior
    state : PsfState
        Where the PSF was found.

    Returns
    -------
    ndarray of bool, shape (ny, nx)
    """
    data = PsfSamples.at(posterior, state.params, state.shifts, state.grid.radius)
    light = observed(posterior, state, data, None).templates[0]
    seen = np.bincount(data.samples.source, light, len(state.fluxes)) >= SEEN
    at, out = posterior.likelihood.image_positions(state.params), posterior.mask.copy()
    inside = np.flatnonzero(np.isfinite(at).all(axis=1))
    (u, v), (rows, columns) = posterior.model.detector.pixel_centres(), np.nonzero(out)
    _, nearest = spatial.cKDTree(at[inside]).query(np.stack([u[columns], v[rows]], axis=1))
    out[rows, columns] = seen[inside[nearest]]
    return out


def _at(posterior: Posterior, state: PsfState, params: Floats) -> PsfState:
    """The state with a posterior's parameters, and the fluxes and shifts that go with them."""
    _, _, fluxes, shifts = posterior.likelihood.own_pixels(params, state.grid.radius)
    return replace(state, params=params, fluxes=fluxes, shifts=shifts)


def _model_error(posterior: Posterior, params: Floats) -> float:
    known = dict(zip(posterior.parameter_names, params, strict=True))
    return float(known.get("model_error", 0.0))


def _at_nodes(posterior: Posterior, state: PsfState, error: float) -> NodeEquations:
    return NodeEquations.of(posterior, state, error, math.inf)


def _information(
    posterior: Posterior, state: PsfState, data: PsfSamples, error: float
) -> PsfInformation:
    pixels = observed(posterior, state, data, error, math.inf)
    return PsfInformation.of(posterior, state, pixels)


def _log_volume(posterior: Posterior, state: PsfState, data: PsfSamples, error: float) -> float:
    """Of the PSF's posterior, the other parameters following, up to a constant.

    With nodes it is theirs, nearly.

    The posterior of those is that with the PSF fixed: their own information is divided out. R being
    the conventions' rows and A the information without them, the determinant within the conventions
    is det A det(R A^-1 R^T) / det(R R^T).
    """
    if state.nodes is not None:
        return _at_nodes(posterior, state, error).log_volume(state.nodes.strength)
    information = _information(posterior, state, data, error)
    size = len(information.matrix)
    equations = PsfEquations(state, information, np.zeros(size), np.zeros(0), error)
    upper, scale = equations.factor
    inner = information.matrix[state.deviations.size :, state.deviations.size :]
    unit = 1.0 / np.sqrt(np.diag(inner))
    lower = np.linalg.cholesky(inner * np.outer(unit, unit))  # of the lower triangle alone
    log_det = 2.0 * float(np.sum(np.log(np.diag(upper))) - np.sum(np.log(scale)))
    log_det += float(np.linalg.slogdet(equations.conventions @ equations.towards)[1])
    log_det -= 2.0 * float(np.sum(np.log(np.diag(lower))) - np.sum(np.log(unit)))
    return -0.5 * log_det

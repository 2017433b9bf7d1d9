"""Errors that hold where neighbouring sources are displaced alike.

`random_field` finds by what field they are, and `model.displacement_errors` says what that adds to
the errors of the parameters. `neighbours` asks whether anything else displaces them alike.
"""

from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy import linalg

from bayesfred._typing import Floats
from bayesfred.analysis.joint_folds import frame_views
from bayesfred.analysis.neighbours import Neighbours, neighbours
from bayesfred.analysis.random_field import (
    FieldLeft,
    Placed,
    find_field,
    placed,
    shared_products,
)
from bayesfred.analysis.score_tests import with_more_terms
from bayesfred.analysis.sources import SourceFits, fit_sources, tabulate
from bayesfred.errors import InputError
from bayesfred.io.summary_table import Table
from bayesfred.model.added_errors import moved_by
from bayesfred.model.displacement_errors import DisplacementErrors
from bayesfred.model.joint import JointPosterior
from bayesfred.model.posterior import Posterior
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import MapEstimate, inverse
from bayesfred.optimize.joint_map import with_frames

__all__ = ["displaced_neighbours", "displacement_lines", "marginalize_displacements"]

SomePosterior = TypeVar("SomePosterior", Posterior, JointPosterior)


def marginalize_displacements(posterior: SomePosterior, estimate: MapEstimate) -> SomePosterior:
    """Let displacements that neighbouring sources have in common widen the parameters' errors.

    Where the frame tells of a random field that displaces its sources, what it adds to the errors
    of sources that scatter independently is found.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
        With positions that scatter; of several frames, in one of them at least.
    estimate : MapEstimate
        Its maximum.

    Returns
    -------
    Posterior or JointPosterior
        With `displacement_errors` about that maximum: find it again, for its covariance. Without
        any where sources scatter independently.

    Raises
    ------
    InputError
        If no positions scatter.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((97, 97)), bf.SourceCatalog.grid(6, 15.0, 1e4), bf.GaussianPSF(1.5),
    ...     bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]))
    >>> posterior = bf.Posterior(
    ...     model, bf.simulate(model, [1e-3, 0.0], 5.0, seed=1),
    ...     nuisances=bf.Nuisances(flux="free", position_scatter=True))
    >>> bf.marginalize_displacements(posterior, bf.find_map(posterior)).displacement_errors is None
    True
    """
    if not any(view.posterior.nuisances.position_scatter for view in frame_views(posterior)):
        raise InputError(
            "nuisances: got positions that do not scatter, expected position_scatter=True, of "
            "which displacements are a part"
        )
    posterior = replace(posterior, displacement_errors=None)
    with one_blas_thread():
        if isinstance(posterior, JointPosterior):
            return _of_frames(posterior, estimate.params)
        found = _of_frame(posterior, estimate.params)
        return posterior if found is None else replace(posterior, displacement_errors=found[0])


def displacement_lines(posterior: SomePosterior, covariance: Floats) -> list[str]:
    """Say what displacements are in the errors, in a line for each frame in which there are any.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
        With `displacement_errors`.
    covariance : ndarray, shape (d, d)
        Of its parameters without these.

    Returns
    -------
    list of str
        Of several frames after each one's name, and of all together in the last.
    """
    lines = []
    for view in frame_views(posterior):
        errors = view.posterior.displacement_errors
        if errors is not None and errors.field is not None:
            before = f"{view.name}: " if view.name else ""
            lines.append(
                f"{before}displacements: neighbouring sources are displaced alike, by "
                f"{errors.sd:.2g} px over {errors.length:.2g} px"
            )
    moved = [k for k, p in enumerate(posterior.parameters) if p.kind == "distortion"]
    added = posterior.displacement_errors
    if added is not None and moved:
        wider = np.sqrt(1.0 + (np.diag(added.covariance) / np.diag(covariance))[moved])
        lines[-1] += (
            f": errors of the coefficients are {wider.min():.2g} to {wider.max():.2g} times those "
            "with sources that scatter independently"
        )
    return lines


def displaced_neighbours(
    posterior: Posterior, params: Floats, fits: SourceFits, sources: Table
) -> Neighbours | None:
    """How far neighbouring sources of a frame are displaced alike, but for what its errors hold.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    fits : SourceFits
    sources : astropy.table.Table
        As `tabulate` makes it of these.

    Returns
    -------
    Neighbours or None
        None where they are too few.
    """
    step, errors = float(posterior.model.detector.binning), posterior.displacement_errors
    known = dict(zip(posterior.parameter_names, params, strict=True))
    scatter = float(known.get("position_scatter", 0.0)) / step
    if errors is None or errors.field is None:
        return neighbours(sources, scatter)
    covariance = inverse(posterior.information(params))
    found = placed(posterior, params, fits)
    left = FieldLeft(errors.field, found, covariance)
    return neighbours(sources, scatter, lambda pairs: left(pairs) / step**2)


def _of_frame(posterior: Posterior, params: Floats) -> tuple[DisplacementErrors, Floats] | None:
    """What displacements add in a frame, and the slopes' covariance; None where there are none."""
    if not posterior.nuisances.position_scatter:
        return None
    fits = fit_sources(posterior, params)
    table = tabulate(posterior, fits)
    sources = placed(posterior, params, fits)
    alone = np.asarray(table["isolated"], dtype=bool)[sources.number]
    more, catalogue = with_more_terms(posterior.model.polynomial), posterior.model.sources
    (u, v), x, y = sources.images.T, catalogue.x[sources.number], catalogue.y[sources.number]
    terms = more.design_matrix(u, v, x, y).swapaxes(0, 1)
    trend = np.concatenate([sources.slopes, terms], axis=2)
    field = find_field(Placed(*(column[alone] for column in sources)), trend[alone])
    if field is None:
        return None
    slopes = shared_products(field, sources, sources.pulls)
    try:
        covariance = widening(posterior, params, slopes)
    except linalg.LinAlgError:  # one of several frames, which tells of its parameters with others
        covariance = np.zeros_like(slopes)
    return DisplacementErrors(posterior.parameter_names, covariance, *field), slopes


def _of_frames(joint: JointPosterior, params: Floats) -> JointPosterior:
    """What displacements add in every frame, which are independent of the others', and together."""
    moved, total = dict[str, DisplacementErrors](), np.zeros((params.size, params.size))
    for view in frame_views(joint):
        found = _of_frame(view.posterior, view.to_frame @ params)
        if found is not None:
            moved[view.name] = found[0]
            total += view.to_frame.T @ found[1] @ view.to_frame
    if not moved:
        return joint
    errors = DisplacementErrors(joint.parameter_names, widening(joint, params, total))
    frames = {
        name: replace(frame, displacement_errors=moved.get(name))
        for name, frame in joint.frames.items()
    }
    widened = with_frames(joint, frames)
    return replace(widened, psf_errors=joint.psf_errors, displacement_errors=errors)


def widening(posterior: Posterior | JointPosterior, params: Floats, slopes: Floats) -> Floats:
    """What slopes of the log-posterior add to the parameters' covariance, and nowhere take from it.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
    params : ndarray, shape (d,)
        Its maximum.
    slopes : ndarray, shape (d, d)
        What is added to the covariance of the gradient there.

    Returns
    -------
    ndarray, shape (d, d)
    """
    information = posterior.information(params)
    scale = 1.0 / np.sqrt(np.diag(information))
    values, vectors = linalg.eigh(
        slopes * np.outer(scale, scale), information * np.outer(scale, scale)
    )
    axes = information @ (scale[:, None] * vectors)
    slopes = axes * np.maximum(values, 0.0) @ axes.T
    return moved_by(posterior.parameter_names, information, slopes)

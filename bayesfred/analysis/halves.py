r"""Two halves of the sources of one frame or several, fitted apart: how far they are apart.

`cross_check` says what is tested and why; here are the numbers, from the fits of the halves to
their difference in independent directions, the displacement field along these, and the positions
that one half predicts for the other's sources.

Positions. Source s of a half is found a_s from where the other half's fit predicts it. The error is
that of its own counts, with the variance D_s, and that of the prediction, F_s C F_s^T, which all
sources have in common: C is the covariance of the fit's m coefficients, F the displacement field.
With C = L L^T and B = D^(-1/2) F L,

    a^T (D + F C F^T)^-1 a = y^T y - (B^T y)^T (1 + B^T B)^-1 B^T y,        y = D^(-1/2) a,

which needs sums over sources alone. Those of several frames are added up.

Displacements that neighbouring sources have in common, where they are in the errors, move both
halves: what they add to the variance of the difference is added, and its directions made
independent again. So far as both halves follow them alike it is less than nothing.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg, stats

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.agreement import Agreement
from bayesfred.analysis.joint_folds import (
    AnyPosterior,
    FrameFolds,
    are_scales,
    columns_of,
    frame_views,
)
from bayesfred.analysis.random_field import placed, shared_products
from bayesfred.analysis.sources import fit_sources, source_table
from bayesfred.errors import InputError
from bayesfred.model.kernels.clusters import DOF
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import inverse
from bayesfred.optimize.find_map import CLOSENESS
from bayesfred.optimize.newton import maximize

__all__ = [
    "Displacements",
    "Half",
    "coefficients",
    "difference",
    "displacements",
    "fit_half",
    "predicted",
]

KNOWN = 0.5  # share of what is known of a direction that the frame has to say
SINGULAR = 1e-13  # eigenvalues of scaled information below this share of the largest are rounding
FIELD = 0.99  # share of the field's expected mean square difference to be tested


class Half(NamedTuple):
    """The likelihood of a half near its maximum.

    Attributes
    ----------
    params : ndarray, shape (d,)
        The maximum of the posterior.
    information : ndarray, shape (d, d)
        I, without the prior.
    estimate : ndarray, shape (d,)
        I t, for t measured from the whole posterior's maximum.
    """

    params: Floats
    information: Floats
    estimate: Floats


class Displacements(NamedTuple):
    """How far the halves' displacement fields are apart.

    Attributes
    ----------
    agreement : Agreement
        In the field's principal components.
    rms, expected : float, pixel
        Root mean square along each axis, and what it is expected to be if the errors are right.
    """

    agreement: Agreement
    rms: float
    expected: float


def fit_half(posterior: AnyPosterior, folds: FrameFolds, fold: int, start: Floats) -> Half:
    """Fit one half.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
        Of both halves.
    folds : FrameFolds
    fold : int
    start : ndarray, shape (d,)
        The maximum of both.

    Returns
    -------
    Half

    Raises
    ------
    InputError
        If its maximum is not found.
    """
    half = folds.only(posterior, fold)
    top = maximize(half, start)
    if not top.distance < CLOSENESS:
        raise InputError(
            f"half {fold + 1}: no maximum found from that of the whole frame, expected "
            f"{int(np.sum(folds.sources == fold))} sources to determine the parameters: fit fewer "
            "terms, or use more sources"
        )
    information = half.fisher(top.params)
    pull = half.gradient(top.params) - half.prior_gradient(top.params)
    return Half(top.params, information, information @ (top.params - start) + pull)


def coefficients(posterior: AnyPosterior) -> Flags:
    """Which parameters move images: the distortion's terms and the pointing.

    Parameters
    ----------
    posterior : Posterior or JointPosterior

    Returns
    -------
    ndarray of bool, shape (d,)
    """
    return columns_of(posterior, _are_coefficients)


def difference(
    posterior: AnyPosterior,
    folds: FrameFolds,
    halves: Sequence[Half],
    start: Floats,
    some: Flags,
) -> tuple[Floats, Floats]:
    """The halves' difference in its independent directions that the data know.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
    folds : FrameFolds
    halves : sequence of Half, length 2
    start : ndarray, shape (d,)
        The maximum of both.
    some : ndarray of bool, shape (d,)
        The m parameters to compare.

    Returns
    -------
    z : ndarray, shape (k,)
        Along each direction, in standard deviations.
    directions : ndarray, shape (m, k), parameter units
        What one standard deviation along each is of the m parameters.
    """
    free = ~columns_of(posterior, are_scales)
    prior = posterior.prior_information(start)
    scale = 1.0 / np.sqrt(np.diag(sum((half.information for half in halves), prior)))[free]
    prior, one, two = (
        matrix[np.ix_(free, free)] * np.outer(scale, scale)
        for matrix in (prior, *(half.information for half in halves))
    )
    first, second = (half.estimate[free] * scale for half in halves)
    both = np.linalg.pinv(one + two, rcond=SINGULAR, hermitian=True)
    known = one @ both @ two
    known, pulls = 0.5 * (known + known.T), np.stack([two @ both, -one @ both])
    wanted = np.flatnonzero(some[free])
    others = np.setdiff1d(np.arange(free.sum()), wanted)
    inner = np.linalg.pinv(known[np.ix_(others, others)], rcond=SINGULAR, hermitian=True)
    through = known[np.ix_(wanted, others)] @ inner
    known = known[np.ix_(wanted, wanted)] - through @ known[np.ix_(others, wanted)]
    pulls = pulls[:, wanted] - through @ pulls[:, others]
    values, vectors = np.linalg.eigh(known + prior[np.ix_(wanted, wanted)])
    usable = values > SINGULAR * values[-1]
    whiten = vectors[:, usable] / np.sqrt(values[usable])
    share, axes = np.linalg.eigh(whiten.T @ known @ whiten)
    axes, share = (whiten @ axes)[:, share > KNOWN], share[share > KNOWN]
    axes = axes / np.sqrt(share)
    pulls = axes.T @ pulls
    z, directions = pulls[0] @ first + pulls[1] @ second, scale[wanted, None] * axes
    moves = np.zeros((2, z.size, free.size))
    moves[:, :, free] = pulls * scale
    spread = np.eye(z.size) + _in_common(posterior, start, folds, moves)
    lower = linalg.cholesky(spread, lower=True)
    return linalg.solve_triangular(lower, z, lower=True), directions @ lower


def _in_common(posterior: AnyPosterior, params: Floats, folds: FrameFolds, moves: Floats) -> Floats:
    """What displacements that the halves' sources have in common add to the difference's variance.

    Parameters
    ----------
    moves : ndarray, shape (2, k, d)
        Of the difference by the gradient of each half's log-likelihood.

    Returns
    -------
    ndarray, shape (k, k)
    """
    total = np.zeros((moves.shape[1], moves.shape[1]))
    for view in frame_views(posterior):
        frame, own = view.posterior, view.to_frame @ params
        errors = frame.displacement_errors
        if errors is None or errors.field is None:
            continue
        found = placed(frame, own, fit_sources(frame, own))
        half = folds.frames[view.name].sources[found.number]
        by_frame = moves @ view.to_frame.T
        by_frame = np.where((half >= 0)[:, None, None], by_frame[half], 0.0)
        by_source = found.pulls @ by_frame.swapaxes(1, 2)
        total += shared_products(errors.field, found, by_source)
    return total


def displacements(
    posterior: AnyPosterior, params: Floats, folds: FrameFolds, z: Floats, directions: Floats
) -> tuple[Displacements, dict[str, Displacements]]:
    """How far apart the halves' displacements are over the field of every frame.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
    params : ndarray, shape (d,)
        Its maximum.
    folds : FrameFolds
    z, directions : ndarray, shape (k,) and (m, k)
        Of `difference`, of all coefficients.

    Returns
    -------
    all : Displacements
        Over the fields of all frames.
    each : dict of str to Displacements
        Over that of each frame.
    """
    products, sizes = dict[str, Floats](), dict[str, int]()
    wanted = coefficients(posterior)
    for view in frame_views(posterior):
        moved = _are_coefficients(view.posterior)
        field = _field(view.posterior, view.to_frame @ params, folds.frames[view.name].points)
        field = field @ view.to_frame[np.ix_(moved, wanted)] @ directions
        products[view.name], sizes[view.name] = field.T @ field, len(field)
    whole = np.sum(list(products.values()), axis=0) / sum(sizes.values())
    each = {name: _displacements(products[name] / sizes[name], z) for name in products}
    return _displacements(whole, z), each


def predicted(
    posterior: AnyPosterior, folds: FrameFolds, fold: int, other: Half
) -> tuple[Agreement, dict[str, Agreement]]:
    """How well the other half's fit predicts where this half's sources are found.

    The positions' errors are those of each source's counts, and of its place in the catalogue where
    positions scatter. They are independent of the prediction's, which all sources share.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
        Of both halves.
    folds : FrameFolds
    fold : int
        This half.
    other : Half

    Returns
    -------
    all : Agreement
        Of the sources of all frames.
    each : dict of str to Agreement
        Of those of each frame.
    """
    half, wanted = folds.only(posterior, fold), coefficients(posterior)
    free = ~columns_of(posterior, are_scales)
    information = other.information + half.prior_information(other.params)
    covariance = inverse(information[np.ix_(free, free)])[np.ix_(wanted[free], wanted[free])]
    total, each = _Sums.zero(len(covariance)), {}
    for view in frame_views(half):
        frame, params = view.posterior, view.to_frame @ other.params
        own = _found(frame, params, folds.frames[view.name].sources == fold)
        to_frame = view.to_frame[np.ix_(_are_coefficients(frame), wanted)]
        each[view.name] = own.agreement(to_frame @ covariance @ to_frame.T)
        total = total.with_frame(own, to_frame)
    return total.agreement(covariance), each


class _Sums(NamedTuple):
    """Sums over sources that positions are judged by."""

    number: int  # of coordinates
    square: float  # y^T y
    pull: Floats  # (m,) F^T D^-1 a
    normal: Floats  # (m, m) F^T D^-1 F

    @classmethod
    def zero(cls, m: int) -> "_Sums":
        return cls(0, 0.0, np.zeros(m), np.zeros((m, m)))

    def with_frame(self, own: "_Sums", to_frame: Floats) -> "_Sums":
        return _Sums(
            self.number + own.number,
            self.square + own.square,
            self.pull + to_frame.T @ own.pull,
            self.normal + to_frame.T @ own.normal @ to_frame,
        )

    def agreement(self, covariance: Floats) -> Agreement:
        lower = linalg.cholesky(covariance, lower=True)
        pull = lower.T @ self.pull
        inner = np.eye(pull.size) + lower.T @ self.normal @ lower
        chi2 = self.square - float(pull @ linalg.solve(inner, pull, assume_a="pos"))
        return Agreement(chi2, self.number, float(stats.chi2.sf(chi2, self.number)))


def _found(frame: Posterior, params: Floats, sources: Flags) -> _Sums:
    """Where a frame's sources are found, against a prediction."""
    table, step = source_table(frame, params)[sources], frame.model.detector.binning
    u, v, du, dv, du_sd, dv_sd = (
        np.array(table[name]) * step for name in ("u", "v", "du", "dv", "du_sd", "dv_sd")
    )
    found = np.isfinite(u + v + du + dv)
    field = _field(frame, params, np.column_stack([u, v])[found])
    errors = np.concatenate([du_sd[found], dv_sd[found]]) ** 2
    tau = dict(zip(frame.parameter_names, params, strict=True)).get("position_scatter", 0.0)
    square = np.tile((du[found] ** 2 + dv[found] ** 2) / DOF, 2)
    errors += (tau**2 + square) * DOF / (DOF + 2.0) if tau else 0.0
    away, weighted = np.concatenate([du[found], dv[found]]), field / errors[:, None]
    return _Sums(away.size, float(away**2 @ (1.0 / errors)), weighted.T @ away, weighted.T @ field)


def _displacements(products: Floats, z: Floats) -> Displacements:
    """From the mean products of the directions' displacements, (k, k)."""
    values, vectors = np.linalg.eigh(products)
    share = np.cumsum(values[::-1]) / np.sum(values)
    kept = vectors[:, ::-1][:, : int(np.searchsorted(share, FIELD)) + 1]
    return Displacements(
        Agreement.of(kept.T @ z),
        math.sqrt(max(float(z @ products @ z), 0.0)),
        math.sqrt(float(np.sum(values))),
    )


def _are_coefficients(frame: Posterior) -> Flags:
    """Which of a frame's parameters move images."""
    terms = (*frame.model.distortion.names, "offset_x", "offset_y")
    return np.isin(frame.parameter_names, terms)


def _field(frame: Posterior, params: Floats, points: Floats) -> Floats:
    """Displacement of images by a unit of each coefficient, to first order in the distortion.

    Returns
    -------
    ndarray, shape (2 n, m), pixel per unit of the coefficient
        Along u at every point, then along v.
    """
    d = frame.model.polynomial
    known = dict(zip(frame.parameter_names, params, strict=True))
    u, v = points.T - np.array([[known.get(name, 0.0)] for name in ("offset_x", "offset_y")])
    x, y = d.object_position(params[: d.n_terms], u, v)
    columns = [-d.design_matrix(u, v, x, y)]
    if frame.nuisances.offset:
        columns.append(np.repeat(np.eye(2)[:, None, :], len(points), axis=1))
    field = np.concatenate(columns, axis=2)
    return np.asarray(field[:, np.isfinite(x + y)].reshape(-1, field.shape[2]))

r"""Whether a frame's errors are right, asked of the frame itself: two halves, fitted apart.

The sources are split into halves that each cover the field (`folds`). Each half's likelihood l_i
has pixels of its own, so its estimate t_i has the covariance I_i^-1, I_i the Fisher information,
and is independent of the other half's. If the errors are right, d = t_1 - t_2 has mean zero and the
information

    C = (I_1^-1 + I_2^-1)^-1 = I_1 (I_1 + I_2)^-1 I_2,

and d^T C d is chi-square. Errors that are too small make it too large, and the reverse.

The prior. Both halves are fitted with the same prior, which draws both estimates to the same place.
Its pull is taken out exactly: t_i is one Newton step of the likelihood alone from half i's maximum
p_i, so with the gradient of the likelihood there

    I_i t_i = I_i p_i + grad l_i(p_i),      C d = I_2 (I_1 + I_2)^-1 I_1 t_1 - the same with 1 and 2
                                                  exchanged,

which needs no inverse of I_i. Were l_i quadratic, d would not depend on the prior at all. With a
normal prior of information P the estimates themselves, J_i^-1 (I_i t_i + P m) with J_i = I_i + P,
differ with the covariance J_1^-1 + J_2^-1 - J_1^-1 P J_2^-1 - J_2^-1 P J_1^-1 if the truth is drawn
from that prior; d needs no such truth.

Nuisances (background, PSF's width, a common flux) are each half's own. The marginal information of
the coefficients is the Schur complement of C. Free fluxes are profiled out of I_i already. The
scatter of the sources' positions, which sets the errors that are on trial, is held at the whole
frame's value: the root of one over the mean of 1 / tau^2 under its nested Laplace approximation,
which makes the mean of d^T C d right where the scatter is estimated from the same sources.

Directions. In coordinates where C + P is the identity, C has eigenvalues between 0 and 1: the share
of what is known that the frame says. Directions below 1/2 are decided by the prior and dropped; the
degrees of freedom are the number of the others. The displacement field is a linear map of the
coefficients. Of its principal components, those that make up 99 % of the mean square difference
expected over the field are kept.

References
----------
B. Efron & C. Stein (1981), Annals of Statistics 9, 586: variance from halves.
A. Gelman, X.-L. Meng, H. Stern (1996), Statistica Sinica 6, 733: checks of a model on its own data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats
from threadpoolctl import threadpool_limits

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.analysis.agreement import Agreement, Verdict
from bayesfred.analysis.folds import Folds, fold_sources
from bayesfred.analysis.sources import source_table
from bayesfred.errors import InputError
from bayesfred.model.kernels.clusters import DOF
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate, inverse
from bayesfred.optimize.find_map import CLOSENESS, find_map
from bayesfred.optimize.newton import maximize
from bayesfred.sampling.moves import LaplaceMove

__all__ = ["CrossCheck", "cross_check"]

KNOWN = 0.5  # share of what is known of a direction that the frame has to say
SINGULAR = 1e-13  # eigenvalues of scaled information below this share of the largest are rounding
HELD = 1e-4  # relative standard deviation of a parameter that is held
FIELD = 0.99  # share of the field's expected mean square difference to be tested


@dataclass(frozen=True, eq=False)
class CrossCheck:
    """What two halves of the sources, fitted apart, say about the errors.

    Attributes
    ----------
    displacement : Agreement
        Of the displacement field over the frame.
    coefficients : Agreement
        Of the distortion's coefficients and the pointing.
    positions : tuple of Agreement
        Of the image positions found in each half with those that the other half's fit predicts;
        `factor` is the weighted root mean square of the differences in standard deviations.
    displacement_rms, displacement_expected : float, pixel
        Root mean square difference of the halves' displacements over the field along each axis, and
        what it is expected to be if the errors are right.
    sources : ndarray of int, shape (n,)
        Half of each source, 0 or 1; -1 where the frame does not hold its image.
    params : ndarray, shape (2, d)
        Maximum of each half.
    """

    displacement: Agreement
    coefficients: Agreement
    positions: tuple[Agreement, Agreement]
    displacement_rms: float
    displacement_expected: float
    sources: Ints
    params: Floats

    @property
    def displacement_p(self) -> float:
        """Probability of a larger chi-square of the displacement if the errors are right."""
        return self.displacement.p

    @property
    def coefficients_p(self) -> float:
        """Probability of a larger chi-square of the coefficients if the errors are right."""
        return self.coefficients.p

    @property
    def deciding(self) -> Agreement:
        """The agreement that the verdict is about: too small comes before too large.

        The displacement's, unless the coefficients alone are not right.
        """
        both = self.displacement, self.coefficients
        for verdict in ("too small", "too large"):
            for each in both:
                if each.verdict == verdict:
                    return each
        return self.displacement

    @property
    def verdict(self) -> Verdict:
        """Whether the errors are too small, right or too large."""
        return self.deciding.verdict

    @property
    def holds(self) -> bool:
        """Whether the errors are right."""
        return self.verdict == "right"

    @property
    def message(self) -> str:
        """The verdict in a sentence, with the power of the check."""
        a = self.deciding
        of = "displacement" if a is self.displacement else "coefficients"
        low, high = a.factor_interval
        scaling = f"multiply them by {a.factor:.2f} ({low:.2f} to {high:.2f})"
        power = f"errors too small by a factor {a.detectable:.2f} would be found in 90 % of cases"
        found = f"{of}: chi-square {a.chi2:.1f} for {a.dof} degrees of freedom, p = {a.p:.2g}"
        if self.holds:
            return f"the errors are right: the halves agree ({found}); {power}"
        return f"the errors are {self.verdict}: {scaling}; {found}; {power}"

    def record(self) -> dict[str, Any]:
        """The findings as numbers and texts by name, as `bayesfred crosscheck --json` prints them.

        Each agreement has `p`, `chi2`, `dof`, `factor`, `factor_low`, `factor_high` and
        `detectable`; of the positions in each half there is the root mean square in standard
        deviations.
        """
        record: dict[str, Any] = {"verdict": self.verdict, "message": self.message}
        for name, a in (("displacement", self.displacement), ("coefficients", self.coefficients)):
            low, high = a.factor_interval
            numbers = {
                "p": a.p, "chi2": a.chi2, "dof": a.dof, "factor": a.factor, "factor_low": low,
                "factor_high": high, "detectable": a.detectable,
            }  # fmt: skip
            record |= {f"{name}_{key}": value for key, value in numbers.items()}
        record["positions_rms_z"] = [a.factor for a in self.positions]
        record["displacement_rms"] = self.displacement_rms
        record["displacement_expected"] = self.displacement_expected
        return record


class _Half(NamedTuple):
    """The likelihood of a half near its maximum."""

    params: Floats  # (d,)
    information: Floats  # (d, d)
    estimate: Floats  # (d,) I t, for t measured from the whole frame's maximum


def cross_check(posterior: Posterior, *, estimate: MapEstimate | None = None) -> CrossCheck:
    """Fit two halves of the sources apart and ask whether they agree within their errors.

    The halves are a checkerboard over the field. Each has the pixels of its own sources, so that
    their counts are independent; every source stays in both models, as its light reaches the
    other half's pixels.

    Parameters
    ----------
    posterior : Posterior
    estimate : MapEstimate, optional
        Its maximum; found if not given.

    Returns
    -------
    CrossCheck

    Raises
    ------
    InputError
        If fewer than two sources have their image in the frame, no coefficient is known by both
        halves, or a half's maximum is not found.

    Notes
    -----
    It tests the errors of one frame: what both halves have in common, such as a wrong PSF that
    moves all images alike, a wrong plate scale of the catalogue or a field that no term describes,
    it does not see. Errors of the linear approximation are neglected. The verdict is "right" where
    both probabilities lie between 0.01 and 0.99. With `position_scatter` the scatter is estimated
    from the same sources: with n sources and k degrees of freedom chi-square varies less, by a
    factor of about 1 - k / 2n in the variance.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion.polynomial(1))
    >>> posterior = bf.Posterior(model, bf.simulate(model, np.zeros(4), 2.0, seed=1))
    >>> found = bf.cross_check(posterior)
    >>> found.verdict, found.displacement.dof
    ('right', 4)
    """
    with threadpool_limits(1, user_api="blas"):
        whole = estimate or find_map(posterior)
        folds = fold_sources(posterior, whole.params, 2)
        n_sources = int(np.sum(folds.sources >= 0))
        if n_sources < 2:
            raise InputError(
                f"catalogue: got {n_sources} sources with an image in the frame, expected at least "
                "2 to make halves of: check positions and mask"
            )
        fixed, start = _scatter_fixed(posterior, whole)
        one, two = (_fitted(fixed, folds, k, start) for k in (0, 1))
        z, directions = _difference(fixed, (one, two), start)
        if not z.size:
            raise InputError(
                f"catalogue: got {n_sources} sources, half of which determine no coefficient, "
                "expected more: fit fewer terms"
            )
        field = _field(posterior, whole.params, folds.points) @ directions
        _, spread, components = np.linalg.svd(field / np.sqrt(len(field)), full_matrices=False)
        share = np.cumsum(spread**2) / np.sum(spread**2)
        kept = components[: int(np.searchsorted(share, FIELD)) + 1]
        return CrossCheck(
            displacement=Agreement.of(kept @ z),
            coefficients=Agreement.of(z),
            positions=(
                _predicted(folds.only(fixed, 0), two, folds.sources == 0),
                _predicted(folds.only(fixed, 1), one, folds.sources == 1),
            ),
            displacement_rms=float(np.sqrt(np.mean((field @ z) ** 2))),
            displacement_expected=float(np.sqrt(np.sum(spread**2))),
            sources=folds.sources,
            params=np.array([one.params, two.params]),
        )


def _scatter_fixed(posterior: Posterior, whole: MapEstimate) -> tuple[Posterior, Floats]:
    """The posterior with the scatter of positions, if any, held, and its parameters so."""
    if not posterior.hyperparameters:
        return posterior, whole.params
    (name,) = posterior.hyperparameters
    k = posterior.parameter_names.index(name)
    nested = LaplaceMove.of(posterior, whole)
    values = nested.means[:, int(np.argmax(nested.order == k))]
    value = float(nested.weights @ values**-2.0) ** -0.5
    start = whole.params.copy()
    start[k] = value
    held = {**posterior.prior, name: stats.norm(value, HELD * value)}
    return replace(posterior, prior=held, extrapolation=None), start


def _fitted(posterior: Posterior, folds: Folds, fold: int, start: Floats) -> _Half:
    """The likelihood of one half near its maximum."""
    half = folds.only(posterior, fold)
    top = maximize(half, start)
    if not top.distance < CLOSENESS:
        raise InputError(
            f"half {fold + 1}: no maximum found from that of the whole frame, expected "
            f"{int(np.sum(folds.sources == fold))} sources to determine the parameters: fit fewer "
            "terms, or use more sources"
        )
    information = half.fisher(top.params)
    pull = half.likelihood.gradient(top.params)
    return _Half(top.params, information, information @ (top.params - start) + pull)


def _difference(
    posterior: Posterior, halves: Sequence[_Half], start: Floats
) -> tuple[Floats, Floats]:
    """The halves' difference in its independent directions that the data know.

    Returns
    -------
    z : ndarray, shape (k,)
        Along each direction, in standard deviations.
    directions : ndarray, shape (m, k), parameter units
        What one standard deviation along each is of the m coefficients.
    """
    names = np.array(posterior.parameter_names)
    free = ~np.isin(names, posterior.hyperparameters)
    prior = posterior.prior_information(start)
    scale = 1.0 / np.sqrt(np.diag(sum((half.information for half in halves), prior)))[free]
    prior, one, two = (
        matrix[np.ix_(free, free)] * np.outer(scale, scale)
        for matrix in (prior, *(half.information for half in halves))
    )
    first, second = (half.estimate[free] * scale for half in halves)
    both = np.linalg.pinv(one + two, rcond=SINGULAR, hermitian=True)
    known = one @ both @ two
    known, pull = 0.5 * (known + known.T), two @ both @ first - one @ both @ second
    wanted = np.flatnonzero(_are_coefficients(posterior, names[free]))
    others = np.setdiff1d(np.arange(free.sum()), wanted)
    inner = np.linalg.pinv(known[np.ix_(others, others)], rcond=SINGULAR, hermitian=True)
    through = known[np.ix_(wanted, others)] @ inner
    known = known[np.ix_(wanted, wanted)] - through @ known[np.ix_(others, wanted)]
    pull = pull[wanted] - through @ pull[others]
    values, vectors = np.linalg.eigh(known + prior[np.ix_(wanted, wanted)])
    usable = values > SINGULAR * values[-1]
    whiten = vectors[:, usable] / np.sqrt(values[usable])
    share, axes = np.linalg.eigh(whiten.T @ known @ whiten)
    axes, share = (whiten @ axes)[:, share > KNOWN], share[share > KNOWN]
    return axes.T @ pull / np.sqrt(share), scale[wanted, None] * axes / np.sqrt(share)


def _are_coefficients(posterior: Posterior, names: NDArray[np.str_]) -> Flags:
    """Which parameters move images: the distortion's terms and the pointing."""
    terms = (*posterior.model.distortion.names, "offset_x", "offset_y")
    return np.isin(names, terms)


def _predicted(half: Posterior, other: _Half, sources: Flags) -> Agreement:
    """How well the other half's fit predicts where this half's sources are found.

    The positions' errors are those of each source's counts, and of its place in the catalogue where
    positions scatter. They are independent of the prediction's, which all sources share.
    """
    named = dict(zip(half.parameter_names, other.params, strict=True))
    table, step = source_table(half, other.params)[sources], half.model.detector.binning
    u, v, du, dv, du_sd, dv_sd = (
        np.array(table[name]) * step for name in ("u", "v", "du", "dv", "du_sd", "dv_sd")
    )
    found = np.isfinite(u + v + du + dv)
    if not found.any():
        return Agreement.of(np.empty(0))
    free = ~np.isin(half.parameter_names, half.hyperparameters)
    names = np.array(half.parameter_names)[free]
    information = other.information + half.prior_information(other.params)
    wanted = _are_coefficients(half, names)
    covariance = inverse(information[np.ix_(free, free)])[np.ix_(wanted, wanted)]
    field = _field(half, other.params, np.column_stack([u, v])[found])
    errors = np.concatenate([du_sd[found], dv_sd[found]]) ** 2
    tau = named.get("position_scatter", 0.0)
    square = np.tile((du[found] ** 2 + dv[found] ** 2) / DOF, 2)
    errors += (tau**2 + square) * DOF / (DOF + 2.0) if tau else 0.0
    lower = linalg.cholesky(field @ covariance @ field.T + np.diag(errors), lower=True)
    away = np.concatenate([du[found], dv[found]])
    return Agreement.of(linalg.solve_triangular(lower, away, lower=True))


def _field(posterior: Posterior, params: Floats, points: Floats) -> Floats:
    """Displacement of images by a unit of each coefficient, to first order in the distortion.

    Returns
    -------
    ndarray, shape (2 n, m), pixel per unit of the coefficient
        Along u at every point, then along v.
    """
    d = posterior.model.polynomial
    known = dict(zip(posterior.parameter_names, params, strict=True))
    u, v = points.T - np.array([[known.get(name, 0.0)] for name in ("offset_x", "offset_y")])
    x, y = d.object_position(params[: d.n_terms], u, v)
    columns = [-d.design_matrix(u, v, x, y)]
    if posterior.nuisances.offset:
        columns.append(np.repeat(np.eye(2)[:, None, :], len(points), axis=1))
    field = np.concatenate(columns, axis=2)
    return np.asarray(field[:, np.isfinite(x + y)].reshape(-1, field.shape[2]))

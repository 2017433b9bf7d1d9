"""Which polynomial a frame needs: it grows while it predicts stars better that it has not seen.

The polynomials are those of `PolynomialDistortion.polynomial`, degree after degree. Each is scored
by cross-validation over sources: the pixels of one star share its errors, so it is whole sources
that are left out. They are dealt to folds that each cover the field (`folds`), and the pixels F of
a fold are predicted from the others, R:

    log p(F | R) = log of int p(F, R | theta) p(theta) d theta / int p(R | theta) p(theta) d theta.

Both integrals are evidences in the Laplace approximation, that of all pixels and that of R alone,

    log Z = log p(theta_max) + log det(2 pi covariance) / 2,

so errors of the coefficients are in the prediction. Free fluxes and the shifts of sources are
integrated out of the likelihoods already; those of the stars in F have their priors, and the same
ones for every polynomial. What a prior of theta is multiplied with cancels.

The sum over folds is the predictive accuracy, elpd. Differences between two polynomials are judged
by the scatter of the folds' differences: a larger degree has to predict better by more than the
standard error. Needless terms do not: k of them gain half a chi-square variable of k degrees of
freedom on the pixels that they are fitted to, and lose k on others. A lens may need cubic terms
and no quadratic ones, so the search ends at the second degree in a row that does not improve on the
best one before it.

A term may be real and yet too small to predict better by that much. So the terms by which a
polynomial differs from the chosen one are judged too, by their size and by their scatter between
the folds (`extra_parameters`).

References
----------
S. Geisser (1975), JASA 70, 320: predictive sample reuse.
A. Vehtari, A. Gelman, J. Gabry (2017), Statistics and Computing 27, 1413: elpd and its errors.
L. Breiman et al. (1984), Classification and Regression Trees, section 3.4.3: one standard error.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats
from bayesfred.analysis.extra_parameters import REAL, judge_extra
from bayesfred.analysis.folds import Folds, fold_sources, require_sources
from bayesfred.errors import InputError
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.io.summary_table import Table, make_table
from bayesfred.model.posterior import Posterior
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.optimize.newton import NewtonResult, maximize

__all__ = ["TermChoice", "choose_terms"]

FOLDS = 10
SCOUT = 3  # degree of the polynomial that says where the images are
FAILURES = 2  # degrees in a row that do not improve, after which the search ends
HIGHEST = 9  # degree; above it powers of pixels leave float64 too few digits


@dataclass(frozen=True, eq=False)
class TermChoice:
    """The polynomial that a frame needs, and what was tried.

    Attributes
    ----------
    distortion : PolynomialDistortion
    posterior : Posterior
        The one that was given, with this distortion.
    estimate : MapEstimate
        Its maximum.
    tried : astropy.table.Table
        A row for each polynomial: `degree`; `n_terms`; `elpd` and `elpd_se`, its predictive
        accuracy with the standard error; `cost` and `cost_se`, by how much less than the chosen one
        it predicts, with the difference's standard error; `p`, the probability that the terms
        that only it or only the chosen one has are chance, nan of the chosen one; `change`, by how
        much it displaces images elsewhere than the chosen one at most over the field, pixel.
    message : str
        What was chosen, what the next leaner polynomial would cost, and which of the larger ones
        have terms that are real though they do not predict better.
    """

    distortion: PolynomialDistortion
    posterior: Posterior
    estimate: MapEstimate
    tried: Table
    message: str

    def lines(self) -> list[str]:
        """What was tried, a line for each polynomial, and the message."""
        return [
            *(
                f"degree {row['degree']}: {row['n_terms']} terms, predicts sources worse by "
                f"{row['cost']:.1f} +- {row['cost_se']:.1f}, displaces images by up to "
                f"{row['change']:.2g} pixel, other terms are chance with p = {row['p']:.2g}"
                for row in self.tried
                if row["n_terms"] != self.distortion.n_terms
            ),
            f"terms: {self.message}",
        ]


class _Fit(NamedTuple):
    """A polynomial fitted to all pixels."""

    degree: int
    posterior: Posterior
    top: MapEstimate


class _Tried(NamedTuple):
    """A polynomial fitted to all pixels, and without each fold."""

    fit: _Fit
    score: Floats  # (K,) log predictive density of each fold
    influence: Floats  # (K, d) of each fold on the estimates
    change: Floats  # (K, d) of the estimates when it is left out


def choose_terms(posterior: Posterior) -> TermChoice:
    """Choose the degree of a polynomial distortion by how well it predicts sources.

    Parameters
    ----------
    posterior : Posterior
        Everything but the terms of its distortion is kept: nuisances, noise, mask, and the priors
        of parameters that the polynomial has as well.

    Returns
    -------
    TermChoice

    Raises
    ------
    InputError
        If fewer than three sources have their image in the frame, or the frame does not determine
        the linear terms.

    Notes
    -----
    The choice is taken for certain by what follows: the errors of the coefficients do not include
    it. Where `tried` has a near rival, its `change` says what the choice may be worth.

    Examples
    --------
    >>> import bayesfred as bf
    >>> truth = bf.PolynomialDistortion.polynomial(2)
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(5, 12.0, 1e4), bf.GaussianPSF(2.0), truth)
    >>> theta = np.zeros(truth.n_terms)
    >>> theta[truth.names.index("f_x2")] = 5e-4
    >>> counts = bf.simulate(model, theta, 2.0, seed=1)
    >>> chosen = bf.choose_terms(bf.Posterior(model, counts))
    >>> chosen.distortion == truth, chosen.tried["degree"].tolist()
    (True, [1, 2, 3, 4])
    """
    with one_blas_thread():
        fits = _fits(posterior)
        # all degrees are scored on the same folds, so images have to be where they are found
        scouts = [*itertools.islice(fits, SCOUT)]
        last = scouts[-1]
        folds = fold_sources(last.posterior, last.top.params, FOLDS)
        require_sources(folds)
        tried: list[_Tried] = []
        best = 0
        for fit in itertools.chain(scouts, fits):
            tried.append(_predicted(fit, folds))
            gain, error = _total(tried[-1].score - tried[best].score)
            if gain > error:
                best = len(tried) - 1
            elif len(tried) - 1 - best >= FAILURES:
                break
        return _choice(tried, best, folds)


def _fits(posterior: Posterior) -> Iterator[_Fit]:
    """Polynomials of rising degree fitted to all pixels, as far as the frame determines them."""
    before: _Fit | None = None
    for degree in range(1, HIGHEST + 1):
        grown = _of_degree(posterior, degree)
        try:
            top = find_map(grown)
        except InputError:
            if before is None:
                raise
            return
        if before is not None:
            start = _carried(before, grown)
            if grown.log_prob(start) > top.log_prob:  # another maximum, and a lower one
                top = find_map(grown, start)
        before = _Fit(degree, grown, top)
        yield before


def _of_degree(posterior: Posterior, degree: int) -> Posterior:
    """The posterior with the polynomial of a degree as its distortion."""
    model = replace(posterior.model, distortion=PolynomialDistortion.polynomial(degree))
    terms = set(posterior.model.distortion.names) - set(model.distortion.names)
    prior = {name: given for name, given in posterior.prior.items() if name not in terms}
    return replace(
        posterior, model=model, prior=prior, extrapolation=None,
        psf_errors=None, displacement_errors=None,
    )  # fmt: skip


def _carried(fit: _Fit, to: Posterior) -> Floats:
    """The parameters of a fit for a posterior with more terms, which are zero."""
    known = dict(zip(fit.posterior.parameter_names, fit.top.params, strict=True))
    return np.array([known.get(name, 0.0) for name in to.parameter_names])


def _predicted(fit: _Fit, folds: Folds) -> _Tried:
    """Fit a polynomial without each fold, and predict the fold."""
    whole = _log_evidence(fit.top)
    number = int(folds.sources.max()) + 1
    rest = [folds.without(fit.posterior, k) for k in range(number)]
    tops = [maximize(posterior, fit.top.params) for posterior in rest]
    gradients = np.array([-posterior.gradient(fit.top.params) for posterior in rest])
    return _Tried(
        fit,
        whole - np.array([_log_evidence(top) for top in tops]),
        gradients @ fit.top.covariance,
        fit.top.params - np.array([top.params for top in tops]),
    )


def _log_evidence(top: MapEstimate | NewtonResult) -> float:
    """Log of the integral of likelihood times prior, in the Laplace approximation."""
    sd = np.sqrt(np.diag(top.covariance))
    _, log_det = np.linalg.slogdet(2.0 * np.pi * top.covariance / np.outer(sd, sd))
    return float(top.log_prob + 0.5 * log_det + np.log(sd).sum())


def _total(values: Floats) -> tuple[float, float]:
    """The sum over folds and its standard error from their scatter."""
    return float(values.sum()), float(np.sqrt(values.size * values.var(ddof=1)))


def _choice(tried: Sequence[_Tried], best: int, folds: Folds) -> TermChoice:
    """The record of what was tried."""
    fits, chosen = [each.fit for each in tried], tried[best].fit
    elpd = np.array([_total(each.score) for each in tried])
    cost = np.array([_total(tried[best].score - each.score) for each in tried])
    distortion = chosen.posterior.model.polynomial
    table = make_table(
        {
            "degree": np.array([fit.degree for fit in fits]),
            "n_terms": np.array([_size(each) for each in tried]),
            "elpd": elpd[:, 0],
            "elpd_se": elpd[:, 1],
            "cost": cost[:, 0],
            "cost_se": cost[:, 1],
            "p": np.array([_chance(*sorted((each, tried[best]), key=_size)) for each in tried]),
            "change": np.array([_largest_change(chosen, fit, folds.points) for fit in fits]),
        }
    )
    return TermChoice(distortion, chosen.posterior, chosen.top, table, _message(table, best))


def _size(tried: _Tried) -> int:
    """Number of terms."""
    return tried.fit.posterior.model.distortion.n_terms


def _chance(leaner: _Tried, larger: _Tried) -> float:
    """Probability that the terms which only the larger polynomial has are chance."""
    if leaner is larger:
        return float("nan")
    known, names = (tried.fit.posterior.parameter_names for tried in (leaner, larger))
    added = [k for k, name in enumerate(names) if name not in known]
    return judge_extra(
        tuple(names[k] for k in added),
        larger.fit.top.params[added],
        larger.fit.top.covariance[np.ix_(added, added)],
        larger.influence[:, added],
        larger.change[:, added],
    ).p


def _message(tried: Table, best: int) -> str:
    """What was chosen, what others would bring, and why the search ended."""
    degrees, chosen = tried["degree"], tried[best]
    message = f"polynomial of degree {chosen['degree']} ({chosen['n_terms']} terms)"
    if best:
        leaner = tried[int(np.nanargmin(tried["cost"][:best]))]
        message += (
            f"; degree {leaner['degree']}, with {leaner['n_terms']} terms, would predict sources "
            f"worse, by {leaner['cost']:.1f} +- {leaner['cost_se']:.1f} in log predictive density, "
            f"and displace images by up to {leaner['change']:.2g} pixel"
        )
    else:
        message += ", the leanest one"
    if larger := [str(degree) for degree in degrees[best + 1 :]]:
        plural = "s" if len(larger) > 1 else ""
        message += f"; degree{plural} {' and '.join(larger)} would not predict better"
    real = [f"{row['degree']} (p = {row['p']:.2g})" for row in tried[best + 1 :] if row["p"] < REAL]
    if real:
        message += f", though terms of degree {' and '.join(real)} are real"
    if len(larger) < FAILURES:
        last = int(degrees[-1])
        message += (
            "; no higher degree is tried: name the terms of another distortion"
            if last == HIGHEST
            else f"; the frame does not determine degree {last + 1}"
        )
    return message


def _largest_change(chosen: _Fit, other: _Fit, points: Floats) -> float:
    """By how much another fit displaces images elsewhere at most over the field, pixel."""
    field, known = chosen.posterior.model.polynomial, _offset(chosen)
    theta = chosen.top.params[: field.n_terms]
    x, y = field.object_position(theta, *(points.T - known))
    images = []
    for fit in (chosen, other):
        d = fit.posterior.model.polynomial
        u_v = np.array(d.image_position(fit.top.params[: d.n_terms], x, y))
        images.append(u_v + _offset(fit))
    return float(np.nanmax(np.hypot(*(images[1] - images[0]))))


def _offset(fit: _Fit) -> Floats:
    """The pointing, shape (2, 1), pixel."""
    known = dict(zip(fit.posterior.parameter_names, fit.top.params, strict=True))
    return np.array([[known.get(name, 0.0)] for name in ("offset_x", "offset_y")])

"""Score tests: whether numbers that are not fitted are what the model takes them to be.

A number phi that the model holds fixed, such as the PSF's width, is right where the derivative of
the log-likelihood by it vanishes but for noise. That derivative is taken at the maximum of the
posterior, without a fit of phi: Rao's score test, or the Lagrange multiplier test. Its power is
that of the likelihood ratio. A sum over all pixels has hardly any: the misfit of one number is one
unit among as many as there are pixels.

The variance. With theta the fitted parameters, U = (U_theta, U_phi) the gradient of the
log-likelihood at the truth, I its Fisher information, P the prior's curvature, m its middle and
C = (I_theta,theta + P)^-1, the maximum lies at theta* + C (U_theta - P (theta* - m)) in linear
approximation. There the derivative by phi is

    S = U_phi - I_phi,theta C (U_theta - P (theta* - m)).

For theta* drawn from the prior both terms in the bracket are independent, of variances I and P, and

    Var S = I_phi,phi - I_phi,theta C I_theta,phi,

exactly. For given theta* the variance is smaller by I_phi,theta C P C I_theta,phi and the mean is
I_phi,theta C P (theta* - m): both vanish with P, so that with a prior which is weak beside the
counts z = S / sqrt(Var S) is a normal number for any truth. Free fluxes and shifts of sources are
profiled out of gradient and information already. A parameter at a bound of its prior is taken as
fixed. S / Var S is the step of Fisher's scoring, an estimate of phi less its value in the model, of
variance 1 / Var S. Displacements that neighbouring sources have in common, where they are in the
errors, move U: what they add to the variance of S is added, and the step remains what it is.

What is tested: the PSF's width, the pointing, a common factor of the fluxes, a slope and a
curvature of the background, and every term x^i y^j that the distortion lacks, up to two degrees
more than it has. A lens that is symmetric about its axis has odd degrees only, so after degree 3
the next that it needs is 5. What the fitted parameters can stand in for, so that less than a
hundredth of I_phi,phi is left, is not tested: there the terms of second order in the errors of
theta matter.

One thing that is wrong moves many of these numbers. `leading` names the one that explains most,
frees it, and goes on while another is significant beside those it has freed.

References
----------
C. R. Rao (1948), Mathematical Proceedings of the Cambridge Philosophical Society 44, 50.
L. G. Godfrey (1988), Misspecification Tests in Econometrics, chapter 1.
S. Holm (1979), Scandinavian Journal of Statistics 6, 65: many tests at one level.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import special

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.checks import Check, largest_deviate, not_tested
from bayesfred.analysis.random_field import placed, shared_products
from bayesfred.analysis.sources import SourceFits, fit_sources
from bayesfred.errors import InputError
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.monomials import Exponents, degree_of, term_name
from bayesfred.model.parameters import parameter_table
from bayesfred.model.posterior import Posterior

__all__ = ["FALSE_ALARM", "Lead", "ScoreTests", "score_tests", "with_more_terms"]

FALSE_ALARM = 0.003  # chance that any of these tests fails if the model is true
RARE = 0.01  # of which the terms of the highest degree have
LEAST = 0.01  # share of a number's information that the fitted parameters must leave
MEANING = "what a fit would add to it, by its score"


class Lead(NamedTuple):
    """A number that is wrong."""

    name: str
    z: float  # beside the numbers before it
    value: float  # in the model
    step: float  # what a fit would add, if the numbers before it are free


@dataclass(frozen=True, eq=False)
class ScoreTests:
    """Scores of the numbers that are not fitted, at the maximum.

    Attributes
    ----------
    names : tuple of str, length k
        As the parameters are named that would free them.
    values : ndarray, shape (k,)
        What the model has for them.
    score : ndarray, shape (k,)
        Derivative of the log-likelihood, what the fitted parameters absorb taken off.
    information : ndarray, shape (k, k)
        About these numbers, what the fitted parameters absorb taken off.
    tested : ndarray of bool, shape (k,)
        Whether the fitted parameters leave enough of it.
    shared : ndarray, shape (k, k), or None
        What displacements in common add to the covariance of the scores, which otherwise is the
        information; None where there are none.
    """

    names: tuple[str, ...]
    values: Floats
    score: Floats
    information: Floats
    tested: Flags
    shared: Floats | None = None

    @property
    def covariance(self) -> Floats:
        """Of the scores, if the model is true, shape (k, k)."""
        return self.information if self.shared is None else self.information + self.shared

    @property
    def z(self) -> Floats:
        """Scores in standard deviations, shape (k,); nan where not tested."""
        return np.where(
            self.tested, self.score / np.sqrt(np.maximum(np.diag(self.covariance), 1e-300)), np.nan
        )

    @property
    def limits(self) -> Floats:
        """The z that any of them exceeds by chance in `FALSE_ALARM` of all true models, shape (k,).

        The many terms of the highest degree have a hundredth of that chance, so that they hide none
        of the others: where they are missing they are far off.
        """
        terms = np.array([name.startswith(("f_", "g_")) for name in self.names], dtype=bool)
        degrees = np.array([degree_of(name) for name in self.names]) * terms
        highest = terms & (degrees == degrees.max(initial=0))
        shared = np.where(highest, RARE, 1.0 - RARE) * FALSE_ALARM
        number = np.where(highest, *(np.sum(self.tested & some) for some in (highest, ~highest)))
        return np.asarray(-special.ndtri(0.5 * shared / np.maximum(number, 1)))

    @property
    def leading(self) -> tuple[Lead, ...]:
        """What is wrong, the number first that explains most; empty where nothing is."""
        found: list[Lead] = []
        score, information, covariance = self.score.copy(), self.information, self.covariance
        full, left = np.diag(information), np.array(self.tested, dtype=bool)
        while left.any():
            z = np.where(left, score / np.sqrt(np.where(left, np.diag(covariance), 1.0)), 0.0)
            best = int(np.argmax(np.where(np.abs(z) > self.limits, np.abs(z), 0.0)))
            if not abs(z[best]) > self.limits[best]:
                break
            step = score[best] / information[best, best]
            found.append(Lead(self.names[best], float(z[best]), float(self.values[best]), step))
            freed = np.eye(score.size)  # scores once it is fitted
            freed[:, best] -= information[:, best] / information[best, best]
            score, information = freed @ score, freed @ information @ freed.T
            covariance = freed @ covariance @ freed.T
            left &= np.diag(information) > LEAST * full
        return tuple(found)

    def joint(self, starts: tuple[str, ...]) -> tuple[float, int]:
        """Chi-square of all tested numbers whose names start so, and its degrees of freedom."""
        some = self.tested & np.array([name.startswith(starts) for name in self.names], dtype=bool)
        scale = 1.0 / np.sqrt(np.diag(self.covariance)[some])
        correlation = self.covariance[np.ix_(some, some)] * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(correlation)
        told = values > LEAST  # apart from the others
        along = (self.score[some] * scale) @ vectors[:, told]
        return float(np.sum(along**2 / values[told])), int(told.sum())

    @property
    def checks(self) -> tuple[Check, ...]:
        """A row for each nuisance, and one for the term of the distortion that is farthest off."""
        rows, z = [], self.z
        is_term = np.array([name[:2] in ("f_", "g_") for name in self.names], dtype=bool)
        for k in np.flatnonzero(~is_term):
            rows.append(self._row(f"score of {self.names[k]}", int(k), float(z[k]), MEANING))
        terms = np.flatnonzero(is_term & np.isfinite(z))
        if terms.size:
            best = int(terms[np.argmax(np.abs(z[terms]))])
            rows.append(
                self._row(
                    f"score of {self.names[best]}", best, largest_deviate(z[best], terms.size),
                    f"the farthest off of {terms.size} terms that the distortion lacks",
                )
            )  # fmt: skip
        return tuple(rows)

    def _row(self, name: str, k: int, z: float, meaning: str) -> Check:
        if not self.tested[k]:
            return not_tested(name, "the fitted parameters stand in for it")
        told = self.information[k, k]
        sd = self.covariance[k, k] ** 0.5 / told
        return Check(name, self.score[k] / told, 0.0, sd, z, meaning)


def score_tests(posterior: Posterior, params: Floats, fits: SourceFits | None = None) -> ScoreTests:
    """Test every number that the model of a frame could fit and does not.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
        The MAP.
    fits : SourceFits, optional
        Of the sources there, where they are at hand.

    Returns
    -------
    ScoreTests

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((97, 97)), bf.SourceCatalog.grid(4, 20.0, 1e4), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> wider = bf.ForwardModel(
    ...     model.detector, model.sources, bf.GaussianPSF(2.1), model.distortion)
    >>> posterior = bf.Posterior(model, bf.simulate(wider, [1e-4], 2.0, seed=1))
    >>> first = score_tests(posterior, bf.find_map(posterior).params).leading[0]
    >>> first.name, round(float(first.value + first.step), 1)
    ('psf_sigma', 2.1)
    """
    model = replace(posterior.model, distortion=with_more_terms(posterior.model.polynomial))
    nuisances = replace(
        posterior.nuisances,
        flux="scale" if posterior.nuisances.flux == "fixed" else posterior.nuisances.flux,
        offset=True,
        psf_sigma=True,
        background_order=_largest_order(posterior),
    )
    table = parameter_table(model, nuisances, posterior.counts[posterior.mask])
    likelihood = replace(
        posterior.likelihood,
        model=model, nuisances=nuisances, parameters=table, extrapolation=None,
    )  # fmt: skip
    likelihood.share_frame(posterior.likelihood)
    known = dict(zip(posterior.parameter_names, params, strict=True))
    names = tuple(p.name for p in table)
    values = np.array([known.get(p.name, p.neutral) for p in table])
    score, information = likelihood.gradient(values), likelihood.fisher(values)

    low, high = posterior.support
    inside = dict(zip(posterior.parameter_names, (low < params) & (params < high), strict=True))
    fitted = [names.index(name) for name in posterior.parameter_names if inside[name]]
    others = [k for k, name in enumerate(names) if name not in known]
    own = [posterior.parameter_names.index(names[k]) for k in fitted]
    prior = posterior.prior_information(params)[np.ix_(own, own)]
    pull = posterior.prior_gradient(params)[own]

    size = np.diag(information).copy()
    size[fitted] += np.diag(prior)
    scale = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))  # powers of pixels differ
    theta = (information[np.ix_(fitted, fitted)] + prior) * np.outer(scale[fitted], scale[fitted])
    cross = information[np.ix_(fitted, others)] * np.outer(scale[fitted], scale[others])
    taken = np.linalg.solve(theta, cross)
    left = information[np.ix_(others, others)] * np.outer(scale[others], scale[others])
    covariance = left - cross.T @ taken
    # the maximum is found up to a small gradient
    score = score[others] * scale[others] - taken.T @ ((score[fitted] + pull) * scale[fitted])
    size, shared = 1.0 / scale[others], None
    if posterior.displacement_errors is not None and posterior.displacement_errors.field:
        fits = fits or fit_sources(posterior, params)
        found = placed(posterior, params, fits, (likelihood, values))
        moves = found.pulls
        moves = moves[..., others] - (moves[..., fitted] * scale[fitted]) @ taken * size
        shared = shared_products(posterior.displacement_errors.field, found, moves)
    return ScoreTests(
        tuple(names[k] for k in others),
        values[others],
        score * size,
        covariance * np.outer(size, size),
        np.diag(covariance) > LEAST * np.diag(left),
        shared,
    )


def _largest_order(posterior: Posterior) -> int:
    """Two or the model's own order, if that is more or the noise admits no other."""
    noise, own = posterior.noise, posterior.nuisances.background_order
    try:
        noise.check(posterior.counts, posterior.mask, posterior.nuisances.flux, 2)
    except InputError:
        return own
    return max(own, 2)


def with_more_terms(distortion: PolynomialDistortion) -> PolynomialDistortion:
    """The distortion with every x^i y^j that it lacks, up to two degrees more than it has.

    Parameters
    ----------
    distortion : PolynomialDistortion

    Returns
    -------
    PolynomialDistortion
    """
    own, given = distortion.names, (distortion.f_terms, distortion.g_terms)
    old = _named(given)
    degree = 2 + max(sum(term) for _, term in old)
    powers = [(i, total - i, 0, 0) for total in range(1, degree + 1) for i in range(total, -1, -1)]
    f, g = ((*each, *(term for term in powers if term not in each)) for each in given)
    rows = _named((f, g))
    added = [row for row in rows if row[1] in powers and term_name(*row) not in own]
    basis = np.zeros((len(rows), len(own) + len(added)))
    change = np.eye(len(own)) if distortion.basis is None else distortion.basis
    basis[[rows.index(row) for row in old], : len(own)] = change
    basis[[rows.index(row) for row in added], range(len(own), basis.shape[1])] = 1.0
    labels = " ".join([*own, *(term_name(*row) for row in added)])
    return PolynomialDistortion(f, g, basis, labels)


def _named(terms: Sequence[Sequence[Exponents]]) -> list[tuple[str, Exponents]]:
    """The terms of f and of g, each with its letter."""
    return [(letter, term) for letter, each in zip("fg", terms, strict=True) for term in each]

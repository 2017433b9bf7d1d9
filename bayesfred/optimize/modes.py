"""Modes of a posterior beside the one that a search found.

Another mode is where the sources are imaged elsewhere and the counts agree about as well. What a
source's light is worth, in log-likelihood, is known at the maximum,

    w = (2 r - 1) (F S)^2 / 2 sd^2,

with the matched filter's signal to noise F S / sd and the share r of the light that was found, see
`matched`. At a distance d from its light a source loses w (1 - exp(-d^2 / 4 s^2)). No mode whose
sources lose more than `HOPELESS` together has any mass. Two kinds of modes lose less.

1. Aliases: sources take each other's places, as those of a regular mask do when it is shifted by a
   pitch or turned. Vectors that map the catalogue onto itself are found in the catalogue. The
   parameters that do so to the images follow by linear least squares, as in `matching`.
2. Noise: fluctuations are worth as much as a faint source. The bright sources, or the prior alone,
   hold the parameters with some error. Where that moves no image by its width, no such mode
   exists. Elsewhere searches begin at the most likely of many draws.

Every start is maximised. A mode with log-density p and covariance C there has the log mass
p + log det(2 pi C) / 2, the Laplace approximation. Between modes of faint sources there may be
mass too. The draws estimate it, and the normal distribution that they come from stands for it.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg, spatial
from scipy.special import logsumexp, ndtr

from bayesfred._typing import Floats, Ints
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import Modes, inverse
from bayesfred.optimize.matched import SourceLight, source_light
from bayesfred.optimize.matching import CENTROID, GATE, Field
from bayesfred.optimize.newton import NewtonResult, maximize

HOPELESS = 60.0  # in log-likelihood; noise makes up for 3 sqrt(2 HOPELESS) = 33 of it at most
NEGLIGIBLE = 1e-4  # share of the mass
SAME = 0.7  # images are moved by more PSF widths than this between two modes
DRAWS = 1024
MOST, MOST_DRAWS = 24, 256  # searches from draws, and draws that they may begin at
MOST_ALIASES = 100  # searches from aliases
LAST, REST = 10, 1e-3  # the others do not matter if the last aliases have less weight than this
BESIDE = 0.5  # PSF widths between a source and the one whose place it takes, at most
LEAST_SHARE = 0.1  # of proposals between the modes
WIDE = 0.1  # ... and of those that reach wherever the bright sources or the prior allow
CLOSE = 1e-2  # standard deviations from a maximum
TURNS = tuple(
    np.array([[c, -s], [s, c]]) @ np.diag([1.0, mirror])
    for mirror in (1.0, -1.0)
    for c, s in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
)


class ModeSearch(NamedTuple):
    """What a search for modes found.

    Attributes
    ----------
    top : NewtonResult
        The highest.
    modes : Modes or None
        None where `top` alone describes the posterior.
    evaluations : int
        Log-posteriors evaluated.
    """

    top: NewtonResult
    modes: Modes | None
    evaluations: int


def find_modes(posterior: Posterior, top: NewtonResult) -> ModeSearch:
    """Look for modes beside a maximum.

    Parameters
    ----------
    posterior : Posterior
    top : NewtonResult
        The maximum.

    Returns
    -------
    ModeSearch
    """
    light = source_light(posterior, top.params)
    if not np.isfinite(top.distance) or not light.inside.any():
        return ModeSearch(top, None, 0)
    around = _Surroundings(posterior, top, light)
    draws = around.draws()
    found, evaluations = [top], 0 if draws is None else len(draws.params)
    modes, n_aliases = [around.images(top.params)], 0
    some: Iterable[Floats] = () if draws is None else draws.params[:MOST_DRAWS]
    floor = top.log_prob - HOPELESS
    for starts, most in ((around.aliases(), MOST_ALIASES), (some, MOST)):
        tried: list[Floats] = []
        for start in starts:
            images = around.images(start)
            if around.among(images, modes) or around.among(images, tried):
                continue
            if len(tried) == most:
                n_aliases = len(found) if most == MOST_ALIASES else n_aliases
                break
            tried.append(images)
            log_prob = float(posterior.log_prob(start))
            if log_prob < floor:  # bright sources not quite in place
                if not np.isfinite(log_prob):
                    continue
                near = maximize(posterior, start, steps=2)
                evaluations += near.evaluations
                if near.log_prob < floor:
                    continue
                start = near.params
            again = maximize(posterior, start)
            evaluations += again.evaluations
            images = around.images(again.params)
            if again.distance < CLOSE and not around.among(images, modes):
                found.append(again)
                modes.append(images)
    best = max(found, key=lambda each: each.log_prob)
    log_mass = _laplace_masses(posterior, found)
    last = log_mass[:n_aliases][-LAST:]
    complete = bool(np.all(np.exp(last - log_mass.max()) < REST))
    return ModeSearch(best, _mixture(found, log_mass, draws, complete=complete), evaluations)


class _Draws(NamedTuple):
    """Possible parameters outside the mode that is known, the most likely first."""

    params: Floats  # (n, d)
    log_mass: Floats  # (n,) of the posterior's mass that each stands for
    mean: Floats  # (d,) of the normal distribution that they come from
    covariance: Floats  # (d, d)
    columns: Ints  # of the parameters in which they differ

    def between(
        self, modes: Sequence[NewtonResult], log_mass: float
    ) -> tuple[float, Floats, Floats]:
        """Share of the mass that is in no mode, its mean and its covariance.

        The modes have `log_mass` together.
        """
        outside, k = np.ones(len(self.params), bool), self.columns.size
        for mode in modes:
            step = (self.params - mode.params)[:, self.columns]
            block = mode.covariance[np.ix_(self.columns, self.columns)]
            squared = np.einsum("nk,kl,nl->n", step, inverse(block), step)
            outside &= squared > k + 3.0 * np.sqrt(2.0 * k)  # a chi-square's expectation and sd
        if not outside.any():
            return 0.0, self.mean, self.covariance
        total = float(logsumexp(self.log_mass[outside]))
        weights = np.exp(self.log_mass[outside] - total)
        mean = weights @ self.params[outside]
        step = self.params[outside] - mean
        # few draws may weigh most; each stands for as much around it as a mode
        covariance = (step.T * weights) @ step + modes[0].covariance
        return float(np.exp(total - np.logaddexp(total, log_mass))), mean, covariance


class _Surroundings:
    """A maximum of a posterior, and where else its counts may be about as likely."""

    def __init__(self, posterior: Posterior, top: NewtonResult, light: SourceLight) -> None:
        self.posterior, self.top = posterior, top
        self.field, self.sigma = Field(posterior), posterior.model.psf.sigma
        self.columns = self.field.columns
        self.position = self.field.predict(top.params[self.columns])
        self.inside = np.flatnonzero(light.inside)
        self.worth = np.zeros(len(light.inside))
        found = np.maximum(2.0 * light.ratio[self.inside] - 1.0, 0.0)
        self.worth[self.inside] = 0.5 * light.power[self.inside] * found

    def images(self, params: Floats) -> Floats:
        """Where the sources in the frame are imaged, shape (n, 2)."""
        return self.field.predict(params[self.columns])[self.inside]

    def among(self, images: Floats, others: list[Floats]) -> bool:
        """Whether these images are those of a known mode."""
        return any(np.hypot(*(images - o).T).max() < SAME * self.sigma for o in others)

    def _lost(self, distance: Floats) -> Floats:
        """The share of its worth that a source loses at a distance from its light."""
        return np.asarray(-np.expm1(-0.25 * (distance / self.sigma) ** 2))

    def _with(self, z: Floats) -> Floats:
        """Parameter vectors with these coefficients and pointings, shape (n, d)."""
        params = np.tile(self.top.params, (len(z), 1))
        params[:, self.columns] = z
        return params

    def aliases(self) -> Iterator[Floats]:
        """Parameters with which the sources take each other's places."""
        field, sources, position = self.field, self.posterior.model.sources, self.position
        catalogue = np.stack([sources.x, sources.y], axis=1)
        tree = spatial.cKDTree(catalogue)
        expected = field.predict(field.centre)
        reach = GATE * field.spread(field.everyone, expected, np.diag(field.scale**2))
        places = self.inside[np.argsort(-self.worth[self.inside], kind="stable")]
        bright = places[self.worth[places] >= 0.5 * self.worth[places[0]]]
        middle = bright[np.argmin(np.hypot(*position[bright].T))]
        distance = np.hypot(*(expected - position[middle]).T)
        nearest = np.argsort(distance, kind="stable")
        nearest = nearest[distance[nearest] < reach[nearest]]
        least = HOPELESS - self.posterior.log_prior(self.top.params)[0]
        error = self.sigma * min(CENTROID, (1.0 + 2.0 * np.median(self.worth[places])) ** -0.5)
        for source, turn in itertools.product(nearest, TURNS):  # the most likely first
            shift = catalogue[middle] - turn @ catalogue[source]
            for some in (places[:64], places):  # few of many tell already
                beside, other = tree.query((catalogue[some] - shift) @ turn)
                far = np.hypot(*(position[some] - expected[other]).T) > reach[other]
                paired = ~far & (beside < BESIDE * self.sigma)
                lost = np.where(paired, 0.0, 1.0)
                if self.posterior.nuisances.flux != "free":
                    ratio = sources.flux[other] / sources.flux[some]
                    lost = np.where(paired, (1.0 - ratio) ** 2, 1.0)
                if lost @ self.worth[some] > HOPELESS or not paired.any():
                    break
            else:
                z, _ = field.fit(other[paired], position[some[paired]], error)
                off = np.hypot(*(field.predict(z)[other] - position[some]).T)
                lost = np.maximum(lost, self._lost(off))
                params = self._with(z[None])
                if lost @ self.worth[some] - self.posterior.log_prior(params)[0] < least:
                    yield params[0]

    def draws(self) -> _Draws | None:
        """Draws of what the bright sources leave possible; None where that is this mode alone."""
        field, inside = self.field, self.inside
        mean, covariance = field.centre, np.diag(field.scale**2)
        if (bright := np.flatnonzero(self.worth > HOPELESS)).size:
            mean, covariance = field.fit(bright, self.position[bright], CENTROID * self.sigma)
        if field.spread(inside, self.position[inside], covariance).max() < SAME * self.sigma:
            return None
        lower = linalg.cholesky(covariance, lower=True)
        normal = np.random.default_rng(0).standard_normal((DRAWS, mean.size))
        z = mean + normal @ lower.T
        design, worth = field.design(inside, self.position[inside]), self.worth[inside]
        possible = np.zeros(len(z), bool)
        for k, moved in enumerate(z - self.top.params[self.columns]):
            distance = np.hypot(*(design @ moved))
            loss = self._lost(distance) @ worth
            possible[k] = loss < HOPELESS and distance.max() > SAME * self.sigma
        if not possible.any():
            return None
        params = self._with(z[possible])
        log_prob = self.posterior.log_prob(params)
        log_density = (
            -0.5 * (normal[possible] ** 2).sum(axis=1)
            - np.log(np.diag(lower)).sum()
            - 0.5 * mean.size * np.log(2.0 * np.pi)
        )
        rest = np.setdiff1d(np.arange(params.shape[1]), self.columns)
        information = inverse(self.top.covariance)[np.ix_(rest, rest)]
        log_mass = log_prob - log_density - np.log(DRAWS) + _log_volume(inverse(information))
        order = np.argsort(-log_prob, kind="stable")
        order = order[np.isfinite(log_prob[order])]
        if not order.size:
            return None
        wide = np.zeros_like(self.top.covariance)
        wide[np.ix_(self.columns, self.columns)] = covariance
        wide[np.ix_(rest, rest)] = inverse(information)
        return _Draws(params[order], log_mass[order], self._with(mean[None])[0], wide, self.columns)


def _laplace_masses(posterior: Posterior, found: list[NewtonResult]) -> Floats:
    """The log masses of modes, as far as the prior's support holds them."""
    low, high = posterior.support
    log_mass = []
    for mode in found:
        sd = np.sqrt(np.diag(mode.covariance))
        within = ndtr((high - mode.params) / sd) - ndtr((low - mode.params) / sd)
        log_mass.append(mode.log_prob + _log_volume(mode.covariance) + np.log(within).sum())
    return np.array(log_mass)


def _mixture(
    found: list[NewtonResult], log_mass: Floats, draws: _Draws | None, *, complete: bool
) -> Modes | None:
    """The modes with any mass, and what there is between them; None where one mode is all."""
    weights = np.exp(log_mass - logsumexp(log_mass))
    order = [k for k in np.argsort(-weights, kind="stable") if weights[k] > NEGLIGIBLE]
    means, covariances = [found[k].params for k in order], [found[k].covariance for k in order]
    weights = weights[order] / weights[order].sum()
    if draws is not None:
        share, mean, covariance = draws.between([found[k] for k in order], logsumexp(log_mass))
        if share > NEGLIGIBLE:
            share = np.clip(share, LEAST_SHARE, 1.0 - LEAST_SHARE - WIDE)
            means = [*means, mean, draws.mean]
            covariances = [*covariances, covariance, draws.covariance]
            weights = np.concatenate([(1.0 - share - WIDE) * weights, [share, WIDE]])
    if len(means) == 1:
        return None
    return Modes(np.array(means), np.array(covariances), weights, len(order), complete)


def _log_volume(covariance: Floats) -> float:
    """The log integral of exp(-x^T C^-1 x / 2)."""
    return float(0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1])

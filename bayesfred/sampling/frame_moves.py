r"""Proposals for several frames: what they share at once, their own parameters frame by frame.

With phi the shared parameters and nu_i those of frame i, the Laplace approximation of an arrowhead
is phi ~ N(m, V) and, given phi, independently

    nu_i ~ N(m_i + B_i (phi - m), C_i),       C_i = I_ii^-1,    B_i = -C_i I_i0,

I the information. A step has two moves.

1. phi is drawn again. The own parameters of some frames are drawn with it; in the others the
   residual r_i = nu_i - B_i (phi - m) stays, which moves nu_i along. One decision for all.
2. In those others nu_i is drawn again given phi, and each frame decides for itself.

Scales, such as the scatter of a frame's positions, stand for their normal scores throughout, since
those of few sources are far from normal: see `normal_scores.py`. Once there are draws, they tell
how far scales widen the other parameters of their frame, see `LaplaceMove`, and those of the frames
that are not drawn with phi the distance of phi from m. B_i has no rows for scales.

Proposals for k frames at once are accepted by the sum of k log-ratios of posterior and proposal. If
frame i's has the variance s_i^2, that of the sum is s^2 = sum s_i^2, and the draws' autocorrelation
time is E[(2 - a) / a], a the share that is accepted from where a walker stands (`_correlation`). A
likelihood of all frames is evaluated for move 1 and one of the others' for move 2. Frames are drawn
together as long as that makes an independent draw cheaper: with nearly normal posteriors all of
them, at little more than one likelihood a draw; else none, at little more than two.

References
----------
L. Tierney (1994), Annals of Statistics 22, 1701 (independence chains, and mixing them in blocks).
"""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from emcee import State
from emcee.moves import Move
from scipy.special import ndtr

from bayesfred._typing import Flags, Floats
from bayesfred.model.joint import JointPosterior
from bayesfred.optimize.estimate import MapEstimate, inverse
from bayesfred.sampling.moves import HEAVY_SHARE, LaplaceMove, funnel_of, moments
from bayesfred.sampling.normal_scores import (
    NormalScores,
    Scores,
    log_slopes,
    to_scores,
    to_values,
)

DRAWS_A_SCALE = 100  # fewer do not tell how much each of many scales widens what is shared
PROBES = (3, 8)  # shared parameters, and own ones for each, that show how normal frames are
KEPT = 4096  # parameter vectors whose log-densities are kept, those of all walkers among them

Parts = Callable[[Floats, Flags | None], Floats]


class _Own(NamedTuple):
    """The own parameters of a frame, given the shared ones."""

    slopes: Floats  # B_i (q_i, p)
    residual: LaplaceMove  # of r_i


class FrameMove(Move):  # type: ignore[misc]
    """Independence proposals of shared parameters, and of each frame's own.

    Parameters
    ----------
    posterior : JointPosterior
    mean : ndarray, shape (d,)
    covariance : ndarray, shape (d, d)
        Those of the proposals, scales by their scores; the frames' own parameters are taken as
        independent given the shared ones.
    log_parts : callable
        As `JointPosterior.log_parts`.
    scores : mapping of int to NormalScores, optional
        Those of the scales.
    draws : ndarray, shape (n, d), optional
        Of the posterior, scales by their scores.
    """

    def __init__(
        self, posterior: JointPosterior, mean: Floats, covariance: Floats,
        log_parts: Parts, scores: Scores = MappingProxyType({}), draws: Floats | None = None,
    ) -> None:  # fmt: skip
        p = posterior.n_shared
        low, high = posterior.support
        self.posterior, self.scores, self.log_parts = posterior, scores, log_parts
        self.centre = mean[:p]
        block = covariance[:p, :p]
        self.shared = LaplaceMove(mean[:p], block, support=(low[:p], high[:p]))
        known = inverse(block)
        self.own = []
        for part in posterior.parts:
            cross = covariance[part.own, :p]
            slopes = cross @ known
            slopes[posterior.scales[part.own]] = 0.0
            given = covariance[np.ix_(part.own, part.own)] + slopes @ block @ slopes.T
            given -= slopes @ cross.T + cross @ slopes.T
            own, funnel = (mean[part.own], given), np.zeros(part.own.size)
            scales = np.flatnonzero(posterior.scales[part.own]).tolist()
            if draws is not None and 0 < len(scales) < part.own.size:
                residuals = draws[:, part.own] - (draws[:, :p] - self.centre) @ slopes.T
                funnel[scales] = funnel_of(residuals, scales)
                own = moments(residuals, funnel)
            residual = LaplaceMove(*own, heavy_share=0.0, funnel=funnel)
            self.own.append(_Own(slopes, residual))
        self.kept: dict[bytes, Floats] = {}
        self.mean, self.funnel = mean, np.zeros(mean.size)
        columns = np.flatnonzero(posterior.scales)
        bounded, needed = len(self.shared.bounds) > 0, DRAWS_A_SCALE * columns.size
        if draws is not None and not bounded and 0 < needed < len(draws):
            both = draws[:, np.r_[:p, columns]]
            self.funnel[columns] = funnel_of(both, range(p, both.shape[1]))
        self.together = self._together()
        for i in np.flatnonzero(self.together):  # whose scales are drawn at the same time
            self.funnel[posterior.parts[i].own] = 0.0
        for i in np.flatnonzero(~self.together):  # of many together one far out would refuse all
            self.own[i].residual.heavy_share = HEAVY_SHARE

    @classmethod
    def of(cls, posterior: JointPosterior, estimate: MapEstimate, log_parts: Parts) -> "FrameMove":
        """The move for a joint posterior, given its maximum."""
        covariance, added = estimate.covariance, posterior.added_covariance
        if added is not None:  # which log_prob has not
            covariance = covariance - added
        mean, (low, high) = estimate.params, posterior.support
        if np.any((mean <= low) | (mean >= high)):  # the paraboloid's top is outside
            mean = mean + covariance @ posterior.gradient(mean)
        sd, mean, unit, scores = np.sqrt(np.diag(covariance)), mean.copy(), np.ones(mean.size), {}
        for k in np.flatnonzero(posterior.scales).tolist():
            typical = max(mean[k], sd[k])
            scores[k] = NormalScores.log_normal(typical, sd[k] / typical)
            mean[k], unit[k] = 0.0, sd[k]
        return cls(posterior, mean, covariance / np.outer(unit, unit), log_parts, scores)

    @classmethod
    def fitted(cls, posterior: JointPosterior, draws: Floats, log_parts: Parts) -> "FrameMove":
        """The move with the mean and covariance of draws, shape (n, d)."""
        scales = np.flatnonzero(posterior.scales).tolist()
        scores = {k: NormalScores.of_draws(draws[:, k]) for k in scales}
        y = to_scores(draws, scores)
        return cls(posterior, y.mean(axis=0), np.cov(y.T, ddof=0), log_parts, scores, y)

    def _volumes(self, y: Floats) -> Floats:
        """Logarithm of the volume of scales over that of their scores, shape (k, n)."""
        slopes = log_slopes(y, self.scores)
        return np.array([slopes[:, part.own].sum(axis=1) for part in self.posterior.parts])

    def _drawn(self, x: Floats, random: np.random.RandomState) -> tuple[Floats, Floats]:
        """Vectors whose shared parameters are new, and log q(old) - log q(new) of these.

        The residuals stay.
        """
        p = self.centre.size
        new = x.copy()
        wider = np.exp((x - self.mean) @ self.funnel)[:, None]
        before = self.centre + (x[:, :p] - self.centre) / wider
        drawn = self.shared.draw(len(x), random)
        new[:, :p] = self.centre + (drawn - self.centre) * wider
        for part, own in zip(self.posterior.parts, self.own, strict=True):
            new[:, part.own] += (new[:, :p] - x[:, :p]) @ own.slopes.T
        return new, self.shared.log_density(before) - self.shared.log_density(drawn)

    def _redraw(self, i: int, x: Floats, random: np.random.RandomState) -> Floats:
        """Draw the own parameters of frame i again, in place; log q(old) - log q(new)."""
        own, columns = self.own[i], self.posterior.parts[i].own
        moved = self._moved(own, x)
        before, after = x[:, columns] - moved, own.residual.draw(len(x), random)
        x[:, columns] = after + moved
        return own.residual.log_density(before) - own.residual.log_density(after)

    def _moved(self, own: _Own, x: Floats) -> Floats:
        """B_i (phi - m) at vectors."""
        return np.asarray((x[:, : self.centre.size] - self.centre) @ own.slopes.T)

    def _together(self) -> Flags:
        """Frames whose own parameters are drawn with the shared ones, shape (k,)."""
        random, k, n = np.random.RandomState(0), len(self.own), PROBES[0] * PROBES[1]
        x = np.zeros((n, self.posterior.n_parameters))
        x[:, : self.centre.size] = np.repeat(self.shared.draw(PROBES[0], random), PROBES[1], axis=0)
        log_q = np.zeros((k, n))
        for i, own in enumerate(self.own):
            residual = own.residual.draw(n, random)
            x[:, self.posterior.parts[i].own] = residual + self._moved(own, x)
            log_q[i] = own.residual.log_density(residual)
        there = self.log_parts(to_values(x, self.scores), None)[:-1] + self._volumes(x)
        ratio = (there - log_q).reshape(k, *PROBES)
        with np.errstate(invalid="ignore"):
            variance = ratio.var(axis=2, ddof=1).mean(axis=1)
        variance = np.nan_to_num(variance, nan=np.inf)
        order = np.argsort(variance, kind="stable")
        total = np.concatenate([[0.0], np.cumsum(variance[order])])
        cost = (2.0 - np.arange(k + 1) / k) * np.array([_correlation(s) for s in np.sqrt(total)])
        together = np.zeros(k, bool)
        together[order[: int(np.argmin(cost))]] = True
        return together

    def propose(self, model: Any, state: State) -> tuple[State, Flags]:
        """New positions for all walkers, and which have new shared parameters."""
        random, before, n = model.random, state.coords, len(state.coords)
        y = first = to_scores(before, self.scores)
        parts = self._parts_at(before)

        def values(y: Floats) -> Floats:
            stays = y == first  # to the last bit
            return np.where(stays, before, to_values(y, self.scores))

        new, factor = self._drawn(y, random)
        for i in np.flatnonzero(self.together).tolist():
            factor += self._redraw(i, new, random)
        factor += (self._volumes(new) - self._volumes(y)).sum(axis=0)
        there = self.log_parts(values(new), None)
        with np.errstate(invalid="ignore"):
            ratio = there.sum(axis=0) - parts.sum(axis=0) + factor
        accepted = np.log(random.random_sample(n)) < ratio
        y = np.where(accepted[:, None], new, y)
        parts = np.where(accepted, there, parts)
        if not self.together.all():
            new, alone = y.copy(), np.flatnonzero(~self.together).tolist()
            factors = np.array([self._redraw(i, new, random) for i in alone])
            factors += (self._volumes(new) - self._volumes(y))[alone]
            there = self.log_parts(values(new), ~self.together)
            for i, own_factor in zip(alone, factors, strict=True):
                columns = self.posterior.parts[i].own
                with np.errstate(invalid="ignore"):
                    ratio = there[i] - parts[i] + own_factor
                taken = np.flatnonzero(np.log(random.random_sample(n)) < ratio)
                y[np.ix_(taken, columns)] = new[np.ix_(taken, columns)]
                parts[i, taken] = there[i, taken]
        if len(self.kept) > KEPT:
            self.kept.clear()
        x = values(y)
        for vector, column in zip(x, parts.T, strict=True):
            self.kept[vector.tobytes()] = column
        return State(x, log_prob=parts.sum(axis=0), random_state=state.random_state), accepted

    def _parts_at(self, x: Floats) -> Floats:
        """The log-densities at the walkers' positions, as far as they are known from before."""
        out = [self.kept.get(vector.tobytes()) for vector in x]
        missing = [k for k, known in enumerate(out) if known is None]
        if missing:
            for k, column in zip(missing, self.log_parts(x[missing], None).T, strict=True):
                out[k] = column
        return np.array(out).T


def _correlation(s: float) -> float:
    """Autocorrelation time of independent proposals whose log-ratio has the standard deviation s.

    If the ratio is normal, log w ~ N(-s^2/2, s^2) of proposals and N(s^2/2, s^2) of the posterior's
    draws, from one of which a = E min(1, w'/w) of the proposals are accepted.
    """
    if not 0.0 < s < 5.0:
        return 1.0 if s == 0.0 else np.inf
    z, weights = np.polynomial.hermite_e.hermegauss(32)
    gap = -(s**2) - s * z
    accepted = ndtr(gap / s) + np.exp(gap + 0.5 * s**2) * ndtr(-(gap + s**2) / s)
    return float(weights @ ((2.0 - accepted) / accepted) / weights.sum())

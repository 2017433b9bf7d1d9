"""Tests of the residuals: what a sum of squares cannot see.

Every check compares a number with what it is for a true model that was fitted.

Randomised PIT. If pixel i has the distribution function F_i then u_i = F_i(n_i), randomised within
the step of a discrete F, is uniform. A chi-square compares its histogram over all pixels with a
flat one: it sees a gain or a read noise that is wrong and tails that are too heavy.

Whiteness. The mean product of standardised residuals of pixels that are one or two apart, along u
and along v, is zero for independent noise, with standard deviation 1/sqrt(pairs). It sees a PSF
that is wrong, light of unknown sources, and resampled pixels.

What a fit absorbs is taken off (`bayesfred.analysis.absorbed`). `bayesfred.analysis.pixel_phase`
and `bayesfred.analysis.neighbours` add checks of the sources' displacements.

References
----------
P. K. Dunn, G. K. Smyth (1996), J. Comp. Graph. Stat. 5, 236: randomised quantile residuals.
A. Gelman, X.-L. Meng, H. Stern (1996), Statistica Sinica 6, 733: posterior predictive checks.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import special

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.absorbed import absorbed
from bayesfred.analysis.checks import Check, deviate, not_tested
from bayesfred.analysis.displacements import displaced_neighbours
from bayesfred.analysis.neighbours import Neighbours, neighbours_check
from bayesfred.analysis.pixel_phase import PixelPhase, phase_check, pixel_phase
from bayesfred.analysis.score_tests import ScoreTests, score_tests
from bayesfred.analysis.shared_noise import SharedNoise, shared_noise
from bayesfred.analysis.source_tests import SourceTests, source_tests
from bayesfred.analysis.sources import SourceFits, fit_sources, tabulate
from bayesfred.io.summary_table import Table
from bayesfred.model.noise import Noise, correlation_ratio
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.matched import image_width

__all__ = ["Residuals", "judge_residuals", "predictive_checks", "randomised_pit"]

BINS = 20  # of the PIT's histogram
FEWEST_IN_BIN = 5
DARK = 0.1  # standard deviations of a pixel, below which its sources' light counts as none
PREDICTED = ("deviance", "Pearson", "largest residual", "PIT")


@dataclass(frozen=True, eq=False)
class Residuals:
    """What the residuals of a fitted frame show.

    Attributes
    ----------
    sources : astropy.table.Table
        See `bayesfred.analysis.sources.source_table`.
    pit : ndarray, shape (n_pixels,), or None
        The randomised PIT; None where the noise model has no distribution function.
    phases : tuple of PixelPhase
        Displacements along u and along v against the pixel phase.
    scores : ScoreTests
        Of what the model does not fit.
    tests : SourceTests
        Of every source.
    shared : SharedNoise or None
        How far neighbouring pixels between the sources are correlated, where that matters.
    neighbours : Neighbours or None
        How far neighbouring sources are displaced alike; None where they are too few.
    checks : tuple of Check
        All of these in one number each.
    """

    sources: Table
    pit: Floats | None
    phases: tuple[PixelPhase, PixelPhase]
    scores: ScoreTests
    tests: SourceTests
    shared: SharedNoise | None
    neighbours: Neighbours | None
    checks: tuple[Check, ...]


def judge_residuals(
    posterior: Posterior, params: Floats, covariance: Floats, *, seed: int = 0
) -> Residuals:
    """Test the residuals of a fitted frame.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
        The MAP.
    covariance : ndarray, shape (d, d)
        Of the parameters, `displacement_errors` included.
    seed : int
        For the randomised PIT.

    Returns
    -------
    Residuals
    """
    fits = fit_sources(posterior, params)
    if posterior.displacement_errors is not None:  # by which the fit follows no counts
        covariance = covariance - posterior.displacement_errors.covariance
    taken = absorbed(posterior, params, covariance, fits)
    pit = randomised_pit(posterior, params, fits, seed=seed, leverage=taken.leverage)
    phases = pixel_phase(posterior, params, covariance, fits)
    scores = score_tests(posterior, params, fits)
    tests = source_tests(posterior, params, covariance, fits, taken)
    sources = tabulate(posterior, fits)
    sources["failed"] = tests.failed
    z, quiet = _standardised(posterior, params, fits)
    alike = displaced_neighbours(posterior, params, fits, sources)
    return Residuals(
        sources,
        pit,
        phases,
        scores,
        tests,
        shared_noise(z, quiet, image_width(posterior, params), correlation_ratio(posterior.noise)),
        alike,
        (
            *scores.checks,
            *tests.checks,
            neighbours_check(alike),
            pit_check(pit),
            *_whiteness(posterior, z, fits, taken.modes),
            *(phase_check(phase, axis) for phase, axis in zip(phases, "uv", strict=True)),
        ),
    )


# --- the randomised PIT ---------------------------------------------------------------------------


def randomised_pit(
    posterior: Posterior,
    params: Floats,
    fits: SourceFits,
    *,
    seed: int = 0,
    leverage: Floats | None = None,
) -> Floats | None:
    """The randomised probability integral transform of all pixels in the likelihood.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    fits : SourceFits
        For the expected counts.
    seed : int
    leverage : ndarray, shape (ny * nx,), optional
        Share of a residual's variance that the fit took away; the residual is scaled up by it.

    Returns
    -------
    ndarray, shape (n_pixels,), or None
        None where the noise model has no distribution function.
    """
    used = posterior.mask
    counts = posterior.counts[used]
    noise = posterior.noise_at(params).at(used)
    level = float(params[posterior.parameter_names.index("background")])
    u = _uniform(
        noise.cumulative(counts, fits.expected[used], level, grain(counts)),
        np.random.default_rng(seed),
    )
    if u is None or leverage is None:
        return u
    return np.asarray(special.ndtr(special.ndtri(u) / np.sqrt(1.0 - leverage[used.ravel()])))


def _uniform(bounds: tuple[Floats, Floats] | None, rng: np.random.Generator) -> Floats | None:
    """A random number between the bounds of each pixel."""
    if bounds is None:
        return None
    below, upto = bounds
    return np.asarray(below + rng.random(below.size) * (upto - below))


def grain(counts: Floats) -> float:
    """The step in which counts are recorded: the least difference of two of them."""
    values = np.unique(counts)
    return float(np.diff(values).min()) if values.size > 1 else 1.0


def pit_check(pit: Floats | None) -> Check:
    """Compare the PIT's histogram with a flat one."""
    name = "PIT"
    if pit is None:
        return not_tested(name, "the noise model has no distribution function")
    bins = min(BINS, pit.size // FEWEST_IN_BIN)
    if bins < 2:
        return not_tested(name, "too few pixels")
    counts = np.histogram(pit, bins, (0.0, 1.0))[0]
    value = float(np.sum((counts - pit.size / bins) ** 2) / (pit.size / bins))
    dof = bins - 1
    return Check(
        name, value, dof, math.sqrt(2.0 * dof), deviate(value, dof),
        "chi-square of the residuals' distribution, as quantiles of the noise model",
    )  # fmt: skip


# --- whiteness ------------------------------------------------------------------------------------


def _standardised(posterior: Posterior, params: Floats, fits: SourceFits) -> tuple[Floats, Flags]:
    """Residuals in standard deviations, 0 where masked; and which pixels lie between the sources.

    Both of shape (ny, nx).
    """
    used = posterior.mask
    residual, quiet = np.zeros(used.shape), np.zeros(used.shape, bool)
    noise, mean = posterior.noise_at(params).at(used), fits.expected[used]
    level = float(params[posterior.parameter_names.index("background")])
    residual[used] = noise.residual(posterior.counts[used], mean, level)
    light = np.abs(mean - posterior.likelihood.background(params)[used])
    quiet[used] = light < DARK * np.sqrt(noise.counts_variance(mean, level))
    return residual, quiet


def _whiteness(
    posterior: Posterior, residual: Floats, fits: SourceFits, modes: Floats
) -> list[Check]:
    """Correlations of residuals one and two pixels apart, along u and along v."""
    used = posterior.mask
    background = len(posterior.nuisances.background_names)
    checks = []
    for lag in (1, 2):
        for axis, name in ((1, "u"), (0, "v")):
            before = (slice(None), slice(None, -lag)) if axis else (slice(None, -lag),)
            after = (slice(None), slice(lag, None)) if axis else (slice(lag, None),)
            both = used[before] & used[after]
            pairs = int(both.sum())
            label = f"correlation along {name}, lag {lag}"
            if not pairs:
                checks.append(not_tested(label, "no pairs of pixels"))
                continue
            product = float(np.sum((residual[before] * residual[after])[both]))
            lost = _lost(fits, modes, lag, axis) + background * pairs / used.sum()
            checks.append(
                Check(
                    label, product / pairs, -lost / pairs, pairs**-0.5,
                    float((product + lost) / math.sqrt(pairs)),
                    f"mean product of residuals {lag} pixel{'s' * (lag > 1)} apart",
                )
            )  # fmt: skip
    return checks


def _lost(fits: SourceFits, modes: Floats, lag: int, axis: int) -> float:
    """By how much the fit lowers the sum of products of residuals that are `lag` apart."""
    ny, nx = fits.expected.shape
    pixel = fits.own.pixel
    key = fits.owner * (ny * nx) + pixel  # ascending: by source, then by pixel
    partner = np.searchsorted(key, key + lag * (1 if axis else nx))
    inside = np.flatnonzero(partner < key.size)
    other = partner[inside]
    inside = inside[same := key[other] == key[inside] + lag * (1 if axis else nx)]
    other = other[same]
    if axis:  # not from the end of a row to the beginning of the next
        row = pixel[inside] // nx == pixel[other] // nx
        inside, other = inside[row], other[row]
    return float(np.sum(modes[inside] * modes[other]))


# --- posterior predictive draws -------------------------------------------------------------------


def predictive_checks(posterior: Posterior, draws: Floats, *, seed: int = 0) -> list[Check]:
    """Compare the frame with frames that the posterior predicts, one for each draw.

    At every draw the frame and a simulated one are compared with the same expected counts. z is the
    normal deviate of the share of draws at which the simulated frame's number is the larger one, so
    50 draws tell it up to 2.3. Free fluxes are those most likely for the frame, which makes it fit
    better than simulated ones by about one unit of chi-square a source.

    Parameters
    ----------
    posterior : Posterior
    draws : ndarray, shape (n, d), parameter units
    seed : int

    Returns
    -------
    list of Check
    """
    rng = np.random.default_rng(seed)
    index, used = posterior.parameter_names.index("background"), posterior.mask
    found = np.empty((len(draws), 2, len(PREDICTED)))
    for params, pair in zip(draws, found, strict=True):
        mu, level = posterior.expected_counts(params), float(params[index])
        noise, base = posterior.noise_at(params), posterior.likelihood.background(params)
        simulated = noise.draw(mu - base, base, rng)
        for counts, row in zip((posterior.counts, simulated), pair, strict=True):
            row[:] = _discrepancies(noise.at(used), counts[used], mu[used], level, rng)
    return [
        not_tested(name, "no draws, or no distribution function")
        if not len(draws) or np.isnan(values).any()
        else _predictive_check(name, *values)
        for name, values in zip(PREDICTED, np.moveaxis(found, 0, 2).swapaxes(0, 1), strict=True)
    ]


def _discrepancies(
    noise: Noise, counts: Floats, mu: Floats, level: float, rng: np.random.Generator
) -> tuple[float, ...]:
    """Deviance, Pearson's statistic, largest residual and the PIT's chi-square of a frame."""
    residual = noise.residual(counts, mu, level)
    pit = _uniform(noise.cumulative(counts, mu, level, grain(counts)), rng)
    return (
        float(np.sum(noise.deviance(counts, mu, level))),
        float(np.sum(residual**2)),
        float(np.max(np.abs(residual))),
        pit_check(pit).value,
    )


def _predictive_check(name: str, observed: Floats, predicted: Floats) -> Check:
    """Where the frame's number lies among those of simulated frames."""
    share = (np.sum(predicted >= observed) + 0.5) / (observed.size + 1.0)
    return Check(
        f"predicted {name}", float(observed.mean()), float(predicted.mean()),
        float(predicted.std(ddof=1)) if predicted.size > 1 else math.nan,
        float(-special.ndtri(share)),
        f"{name} of the frame against that of frames simulated at draws",
    )  # fmt: skip

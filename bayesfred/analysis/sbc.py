"""Whether error bars hold, by simulation-based calibration.

Truths are drawn from the prior and ranked among the draws of their frames' posteriors.

Only for the exact posterior is the truth like one more draw, so that any error of model, optimiser
or sampler shows in the ranks.

References
----------
S. Talts, M. Betancourt, D. Simpson, A. Vehtari, A. Gelman (2018), arXiv:1804.06788. M. Modrak et
al. (2023), Bayesian Analysis 20, 461 (quantities that depend on the data, such as the
log-likelihood).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import erfc

from bayesfred._typing import Floats, PathLike
from bayesfred.analysis.ecdf_bands import uniformity
from bayesfred.analysis.executor import Executor, run
from bayesfred.analysis.flux_draws import draw_fluxes
from bayesfred.analysis.prior_predictive import drawn_from_prior
from bayesfred.analysis.study_helpers import (
    LEVELS,
    Method,
    check,
    coverage_error,
    covered,
    draws,
    given,
    maximum,
    seeds,
)
from bayesfred.errors import InputError
from bayesfred.model.parameters import displacing
from bayesfred.model.posterior import Posterior
from bayesfred.sampling.chainfile import fingerprint

__all__ = ["SBCResult", "simulation_based_calibration"]

RANKED = 200  # draws among which a truth is ranked, at least

# Field points, in half-widths of the frame, where the displacement is judged: the last is a corner.
FIELD_POINTS = ((0.7, 0.4), (-0.4, 0.7), (1.0, -1.0))

COLUMNS = (
    "quantity", "uniformity", *(
        f"coverage_{100 * level:.0f}{error}" for level in LEVELS for error in ("", "_error")
    ), "bias", "bias_error", "pull", "pull_error",
)  # fmt: skip
FALSE_ALARM = 0.01  # how often the verdict may refuse error bars that hold
MOST_FAILED = 0.01  # share of frames without a posterior beyond which the others say nothing


@dataclass(frozen=True)
class _Calibration:
    """The tasks of a calibration.

    Each draws a truth from the prior and simulates its frame; it samples the frame's posterior and
    ranks the truth among the draws.
    """

    posterior: Posterior
    fitted: Posterior
    method: Method
    seed: int

    @cached_property
    def quantities(self) -> tuple[str, ...]:
        """What is ranked."""
        places = (
            f"displacement_{axis}({u:+.0f}, {v:+.0f})"
            for axis in self._axes
            for u, v in self._places
        )
        fluxes = (f"flux({s})" for s in self._sources)
        return (*self.posterior.parameter_names, "log_likelihood", *places, *fluxes)

    @cached_property
    def _places(self) -> Floats:
        """Image points where the displacement is judged, shape (n, 2), fine pixel."""
        return 0.5 * (np.array(self.posterior.model.detector.fine_shape[::-1]) - 1) * FIELD_POINTS

    @cached_property
    def _axes(self) -> str:
        """Those along which anything can be displaced."""
        distortion, names = self.posterior.model.polynomial, self.posterior.parameter_names
        moved = distortion.design_matrix(*[self._places[:, i % 2] for i in range(4)])
        return "".join(
            axis
            for axis, factors in zip("xy", moved, strict=True)
            if factors.any() or f"offset_{axis}" in names
        )

    @cached_property
    def _sources(self) -> tuple[int, ...]:
        """Those whose fluxes are judged: the faintest, the median and the brightest."""
        if self.fitted.nuisances.profiled != 1:
            return ()
        order = np.argsort(self.posterior.model.sources.flux, kind="stable")
        return tuple(dict.fromkeys(order[[0, order.size // 2, -1]].tolist()))

    @property
    def columns(self) -> tuple[str, ...]:
        each = (
            f"{name}.{what}" for name in self.quantities for what in ("truth", "mean", "sd", "pit")
        )
        return ("draws", *each)

    def contents(self) -> dict[str, str]:
        fitted = {f"fitted {name}": value for name, value in fingerprint(self.fitted).items()}
        return {
            **fingerprint(self.posterior),
            **fitted,
            "method": self.method,
            "seed": str(self.seed),
        }

    def task(self, k: int) -> Sequence[float]:
        for_truth, for_draws, for_ranks = seeds(self.seed, k).spawn(3)
        truth, fluxes, counts = self.truth(np.random.default_rng(for_truth))
        posterior, rng = given(self.fitted, counts), np.random.default_rng(for_ranks)
        params = self.drawn(posterior, for_draws)
        drawn = self._judged(posterior, params)
        true = self._judged(posterior, truth[None])[0]
        if self._sources:
            some = list(self._sources)
            light = np.array([draw_fluxes(posterior, each, some, rng) for each in params])
            drawn, true = np.hstack([drawn, light]), np.append(true, fluxes[some])
        if not (np.all(np.isfinite(drawn)) and np.all(np.isfinite(true))):
            raise InputError("displacement: got none at some point of the field, expected one")
        below, equal = (drawn < true).sum(axis=0), (drawn == true).sum(axis=0)
        jitter = rng.random(true.size)
        pit = (below + jitter * (equal + 1)) / (len(drawn) + 1)
        each = np.stack([true, drawn.mean(axis=0), drawn.std(axis=0, ddof=1), pit], axis=1)
        return (len(drawn), *each.ravel())

    def drawn(self, posterior: Posterior, seed: np.random.SeedSequence) -> Floats:
        """The posterior's draws."""
        return draws(posterior, maximum(posterior), self.method, seed, RANKED)

    def truth(self, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
        """Parameters and fluxes from their priors, and a frame of theirs."""
        fluxes = self.posterior.model.sources.flux
        if self.posterior.nuisances.flux == "free":
            fluxes = self.posterior.likelihood.draw_fluxes(rng)
        params, counts, _ = drawn_from_prior(self.posterior, rng, fluxes)
        return params, fluxes, counts

    def _judged(self, posterior: Posterior, params: Floats) -> Floats:
        """The quantities that are ranked, fluxes left out, shape (n, number)."""
        likelihood = posterior.log_prob(params) - posterior.log_prior(params)
        theta, offset = displacing(posterior.parameters, params)
        u, v = self._places.T
        x, y = posterior.model.polynomial.object_position(theta, u, v, offset=offset)
        moved = {"x": u - x, "y": v - y}
        return np.hstack([params, likelihood[:, None], *(moved[axis] for axis in self._axes)])


@dataclass(frozen=True, eq=False)
class SBCResult:
    """Whether a posterior's error bars hold.

    Attributes
    ----------
    path : Path
        The table with a row for every simulated frame.
    calibrated : bool
        Whether the truths are ranked among the posterior's draws as one more draw would be.
    message : str
        The verdict and its reasons, one line.
    n : int
        Frames that have a posterior.
    n_failed : int
        Frames that have none.
    pit : dict of str to ndarray, shape (n,)
        Randomised ranks of the truths, between 0 and 1, by quantity: every parameter, the
        log-likelihood, the displacement at points of the image, of which the last is a corner
        (fine pixel), and free fluxes of the faintest, the median and the brightest source (counts).
    quantities : dict of str to ndarray
        A row for each of them: see `simulation_based_calibration`. Without rows where no frame has
        a posterior.
    """

    path: Path
    calibrated: bool
    message: str
    n: int
    n_failed: int
    pit: dict[str, Floats]
    quantities: dict[str, npt.NDArray[Any]]


def simulation_based_calibration(
    posterior: Posterior,
    *,
    fitted: Posterior | None = None,
    replicates: int = 1000,
    method: Method = "mcmc",
    path: PathLike,
    seed: int,
    executor: Executor | None = None,
    workers: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
) -> SBCResult:
    """Simulation-based calibration: rank truths from the prior among the posterior's draws.

    Of each frame at least 200 draws an autocorrelation time apart are kept. With randomised ranks,
    the share of draws below the truth is exactly uniform if and only if truth and draws come from
    one distribution.

    Every row of `SBCResult.quantities` has the quantity's name; uniformity, the p-value
    of its ranks' whole distribution function; coverage_68 and coverage_95, the shares of central
    intervals that hold the truth, with their binomial errors; bias, the mean of (posterior mean -
    truth) with its error; pull, the mean of that difference over the posterior's sd, and
    pull_error, 1/sqrt(n). The verdict takes all p-values together, those of coverage and of pull
    too: posteriors that are exact are refused in at most one study of 100 (Bonferroni), and so is a
    study in which over 1 % of the frames have no posterior.

    Parameters
    ----------
    posterior : Posterior
        Of any frame: the model, priors, noise, mask and nuisances are used, the counts are not.
        Every prior has to be proper, and all are here; the default ones are broad, so that a study
        may rather be of narrower ones.
    fitted : Posterior, optional
        What is fitted, if it is another than what frames are drawn from: to see what a wrong model
        does to the error bars.
    replicates : int
        Frames to simulate.
    method : {"mcmc", "laplace"}
        Draws of the sampler, or of the Laplace approximation, to see whether that suffices.
    path, seed, executor, workers, resume, overwrite, progress
        As of `noise_study`.

    Returns
    -------
    SBCResult

    Raises
    ------
    InputError
        If the posteriors differ in parameters, the file exists or holds another study, or a worker
        dies.
    KeyboardInterrupt
        After every finished frame was kept.

    References
    ----------
    S. Talts et al. (2018), arXiv:1804.06788. T. Saeilynoja, P.-C. Buerkner, A. Vehtari (2022),
    Statistics and Computing 32, 32.

    Examples
    --------
    >>> import tempfile
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((41, 41)), bf.SourceCatalog.grid(3, 12.0, 1e3), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [0.0], 2.0, seed=1))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     study = simulation_based_calibration(
    ...         posterior, replicates=20, path=f"{folder}/sbc.ecsv", seed=1, workers=1,
    ...         progress=False)
    >>> study.calibrated, study.n, study.quantities["quantity"][:3].tolist()
    (True, 20, ['f_ux', 'background', 'log_likelihood'])
    """
    judged = fitted or posterior
    check("calibration", replicates, method, judged.noise)
    if judged.parameter_names != posterior.parameter_names:
        raise InputError(
            f"calibration: fitted: got the parameters {', '.join(judged.parameter_names)}, "
            "expected those of the posterior: "
            f"{', '.join(posterior.parameter_names)}"
        )
    return _calibrate(
        _Calibration(posterior, judged, method, seed),
        replicates,
        path=path,
        executor=executor,
        workers=workers,
        resume=resume,
        overwrite=overwrite,
        progress=progress,
    )


def _calibrate(study: _Calibration, replicates: int, **how: Any) -> SBCResult:
    """Run a calibration's tasks and judge them."""
    meta = {"study": "sbc", "seed": study.seed, "method": study.method, "replicates": replicates}
    rows = run(study, replicates, meta=meta, **how).columns
    good = rows["message"] == ""
    n, n_failed = int(good.sum()), int((~good).sum())
    path = Path(how["path"])
    if n < 2:
        reason = rows["message"][~good][0]
        message = f"not calibrated: no posterior of {n_failed} frames ({reason})"
        nothing = {name: np.empty(0, "U1" if name == "quantity" else float) for name in COLUMNS}
        return SBCResult(path, False, message, n, n_failed, {}, nothing)
    table: list[dict[str, Any]] = []
    pits: dict[str, Floats] = {}
    checks: list[tuple[float, str]] = []
    for name in study.quantities:
        truth, mean, sd, pit = (
            rows[f"{name}.{what}"][good] for what in ("truth", "mean", "sd", "pit")
        )
        pits[name] = pit
        pull, off = (mean - truth) / sd, mean - truth
        row: dict[str, Any] = {"quantity": name, "uniformity": uniformity(pit)}
        checks.append((row["uniformity"], f"ranks of {name} are not uniform"))
        for level in LEVELS:
            key, share = f"coverage_{100 * level:.0f}", float(covered(pit, level).mean())
            row |= {key: share, f"{key}_error": coverage_error(level, n)}
            checks.append(
                (
                    _chance((share - level) / coverage_error(level, n)),
                    f"{level:.0%} intervals of {name} hold {share:.1%}",
                )
            )
        row |= {"bias": float(off.mean()), "bias_error": float(off.std(ddof=1)) / math.sqrt(n)}
        row |= {"pull": float(pull.mean()), "pull_error": 1.0 / math.sqrt(n)}
        if name != "log_likelihood":  # whose posterior is not symmetric
            checks.append(
                (_chance(row["pull"] * math.sqrt(n)), f"mean pull of {name} is {row['pull']:+.3f}")
            )
        table.append(row)
    failures = [(p, text) for p, text in sorted(checks) if p * len(checks) < FALSE_ALARM]
    reasons = [f"{text} (p = {p:.1g})" for p, text in failures[:3]] + (
        ["..."] if len(failures) > 3 else []
    )
    if n_failed > MOST_FAILED * (n + n_failed):
        reasons.append(
            f"{n_failed} of {n + n_failed} frames have no posterior ({rows['message'][~good][0]})"
        )
    least = min(checks)[0] * len(checks)
    message = "not calibrated: " + "; ".join(reasons) if reasons else (
        f"calibrated: {n} frames, {len(pits)} quantities, {len(checks)} checks of which the least "
        "likely has a chance of "
        f"{min(least, 1.0):.2g} among as many"
    )  # fmt: skip
    columns = {key: np.array([row[key] for row in table]) for key in COLUMNS}
    return SBCResult(path, not reasons, message, n, n_failed, pits, columns)


def _chance(z: float) -> float:
    """p-value of a standard normal deviation to either side."""
    return float(erfc(abs(z) / math.sqrt(2.0)))

"""How well a distortion can be known: fits of simulated frames, against the Cramer-Rao bound."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from bayesfred._typing import Flags, Floats, PathLike
from bayesfred.analysis.executor import Executor, run
from bayesfred.analysis.field import field_points, pixel_unit, rms
from bayesfred.analysis.noise_summary import summarise
from bayesfred.analysis.photons import laplace_error, photons_needed, rounded
from bayesfred.analysis.study_helpers import (
    Method,
    check,
    draws,
    given,
    maximum,
    seeds,
)
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import Noise, PoissonNoise
from bayesfred.model.parameters import SCALES, Nuisances, displacing
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import inverse
from bayesfred.optimize.fit_statistics import fit_statistics
from bayesfred.sampling.chainfile import fingerprint

__all__ = ["NoiseStudy", "noise_study"]

VARIABLES = ("background", "flux", "sources", "psf_sigma", "exposure")
MOST_CELLS = 10_000
ESS = 1000  # effective draws of every posterior


@dataclass(frozen=True)
class _Levels:
    """The tasks of a noise study: every replicate of every cell.

    The first replicate of all cells comes first, then the second.
    """

    model: ForwardModel
    theta: tuple[float, ...]
    cells: tuple[dict[str, float], ...]
    method: Method
    noise: Noise
    nuisances: Nuisances
    prior: Mapping[str, Any] | None
    mask: Flags | None
    seed: int

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.model.distortion.names, "background", *self.nuisances.names)

    @property
    def columns(self) -> tuple[str, ...]:
        each = (
            f"{name}.{what}"
            for name in self.names
            for what in ("truth", "estimate", "sd", "bound", "pit")
        )
        field = ("displacement.error", "displacement.predicted")
        whole = ("chi2", "lambda", "deviance", "theta.distance", *field)
        return ("replicate", *VARIABLES, *whole, *each)

    def contents(self) -> dict[str, str]:
        posterior, _ = self.cell(0)
        return {
            **fingerprint(posterior),
            "grid": repr(self.cells),
            "method": self.method,
            "seed": str(self.seed),
        }

    def cell(self, j: int) -> tuple[Posterior, Floats]:
        """The posterior of a frame without noise, and the true parameters."""
        c = self.cells[j]
        s = self.model.sources
        kept = _spread(s, round(c["sources"]))
        flux = s.flux[kept] * (c["flux"] / s.flux.mean() * c["exposure"])
        psf = self.model.psf
        if isinstance(psf, GaussianPSF):
            psf = replace(psf, sigma=c["psf_sigma"])
        sources = replace(s, x=s.x[kept], y=s.y[kept], flux=flux)
        model = replace(self.model, sources=sources, psf=psf)
        level = c["background"] * c["exposure"]
        frame = model.expected_counts(self.theta, level)
        posterior = Posterior(
            model,
            frame,
            prior=self.prior,
            noise=self.noise,
            mask=self.mask,
            nuisances=self.nuisances,
        )
        known = {"background": level, "flux_scale": 1.0, "psf_sigma": psf.sigma}
        return posterior, np.array(
            [*self.theta, *(known.get(name, 0.0) for name in self.names[len(self.theta) :])]
        )

    def task(self, k: int) -> Sequence[float]:
        replicate, j = divmod(k, len(self.cells))
        template, truth = self.cell(j)
        for_frame, for_draws = seeds(self.seed, k).spawn(2)
        level = float(truth[len(self.theta)])
        counts = self.noise.draw(
            template.model.expected_counts(self.theta), level, np.random.default_rng(for_frame)
        )
        posterior = given(template, counts)
        estimate = maximum(posterior)
        if self.method == "mcmc":
            drawn = draws(posterior, estimate, self.method, for_draws, ESS)
            middle, sd, pit = (
                drawn.mean(axis=0),
                drawn.std(axis=0, ddof=1),
                (drawn < truth).mean(axis=0),
            )
        else:
            middle, sd = estimate.params, np.sqrt(np.diag(estimate.covariance))
            pit = ndtr((truth - middle) / sd)
        bound = inverse(posterior.fisher(truth))
        d = len(self.theta)
        off = (middle - truth)[:d]
        fit = fit_statistics(posterior, middle)
        deviance = (fit["deviance"] - fit["deviance_expected"]) / fit["deviance_sd"]
        each = np.stack([truth, middle, sd, np.sqrt(np.diag(bound)), pit], axis=1)
        distance = off @ np.linalg.solve(bound[:d, :d], off)
        cell = (self.cells[j][name] for name in VARIABLES)
        return (
            replicate,
            *cell,
            fit["chi2_paper"],
            fit["background_estimate"],
            deviance,
            distance,
            *_field_errors(posterior, middle, truth),
            *each.ravel(),
        )


def _field_errors(posterior: Posterior, params: Floats, truth: Floats) -> tuple[float, float]:
    """The rms error over the field of an estimate, and the one that the information predicts."""
    points = field_points(posterior, truth)
    theta, offset = displacing(posterior.parameters, np.stack([params, truth]))
    found = np.array(
        posterior.model.polynomial.object_position(theta, points.u, points.v, offset=offset)
    )
    off = np.sqrt(0.5 * np.sum((found[:, 0] - found[:, 1]) ** 2, axis=0))
    return rms(points.weights, off), laplace_error(posterior, truth, points)


def _spread(sources: SourceCatalog, n: int) -> npt.NDArray[np.intp]:
    """The n brightest sources.

    Among equally bright ones each is the farthest from those before it.
    """
    if n == len(sources):
        return np.arange(n)
    apart = np.full(n_all := len(sources), np.inf)
    chosen = np.zeros(n_all, bool)
    for _ in range(n):
        free = np.flatnonzero(~chosen)
        brightest = free[sources.flux[free] == sources.flux[free].max()]
        s = brightest[np.argmax(apart[brightest])]
        chosen[s] = True
        apart = np.minimum(apart, np.hypot(sources.x - sources.x[s], sources.y - sources.y[s]))
    return np.flatnonzero(chosen)


@dataclass(frozen=True, eq=False)
class NoiseStudy:
    """What a noise study found.

    Attributes
    ----------
    path : Path
        The table with a row for every frame.
    parameter_names : tuple of str
    replicates : dict of str to ndarray
        That table: `task`, `replicate`, the cell's variables, chi2, lambda, the deviance in
        standard deviations, the distance of theta from its truth in the metric of the bound,
        squared; the rms error of the displacement over the field and its predicted value, pixel;
        and for every parameter its truth, estimate, sd, bound and PIT (the posterior
        probability of values below the truth); `message` says why a frame has no numbers.
    cells : dict of str to ndarray
        A row for every cell and parameter, and one for theta as a whole: see `noise_study`.
    message : str
        One line: frames, failures, efficiency, coverage.
    """

    path: Path
    parameter_names: tuple[str, ...]
    replicates: dict[str, npt.NDArray[Any]]
    cells: dict[str, npt.NDArray[Any]]
    message: str


def noise_study(
    model: ForwardModel,
    theta: npt.ArrayLike,
    background: float | Sequence[float],
    *,
    flux: Sequence[float] = (),
    sources: Sequence[int] = (),
    psf_sigma: Sequence[float] = (),
    exposure: Sequence[float] = (),
    replicates: int = 50,
    method: Method = "laplace",
    noise: Noise = PoissonNoise(),
    nuisances: Nuisances = Nuisances(),
    prior: Mapping[str, Any] | None = None,
    mask: npt.ArrayLike | None = None,
    path: PathLike,
    seed: int,
    executor: Executor | None = None,
    workers: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    error: float = 0.01,
) -> NoiseStudy:
    """Fit many simulated frames at every cell of a grid of noise levels.

    Every row of `NoiseStudy.cells` has the cell's variables; the number of frames that were fitted
    and that failed; the mean chi2 (the paper's) and lambda (its estimate of the background, counts
    per pixel); and of one parameter: truth, width (mean posterior sd), bias (mean estimate less
    truth), scatter (sd of the estimates), bound (Cramer-Rao, as an sd; without the prior),
    efficiency (bound^2 / scatter^2), coverage_68 and coverage_95, the shares of frames whose
    central intervals hold the truth. `_error` is the Monte Carlo error. In the row `theta`,
    efficiency is the number of coefficients over their mean squared distance from the truth in the
    metric of the bound, and coverage the mean of theirs; displacement_rms is the rms error of the
    displacement over the field and over the frames, along one axis, displacement_predicted what
    Fisher information and prior say it is, and photons the mean flux of the sources at which that
    would be `error`, over the same background.

    Parameters
    ----------
    model : ForwardModel
    theta : array_like, shape (n_terms,)
        The true coefficients. Nuisances have their neutral values.
    background : float or sequence of float, counts per pixel
    flux : sequence of float, counts
        Mean flux of the sources; without it, and without those below, as in the model.
    sources : sequence of int
        Numbers of sources: the brightest. Among equally bright ones, the most widely spaced.
    psf_sigma : sequence of float, pixel
    exposure : sequence of float
        Factors of flux and background together.
    replicates : int
        Frames of every cell.
    method : {"laplace", "mcmc"}
        Maximum and Fisher information alone, or draws.
    noise, nuisances, prior, mask
        As of `Posterior`. Default priors are those of the cell's frame without noise.
    path : path-like
        The table, .ecsv, that keeps every frame's numbers as they come.
    seed : int
        The same seed gives the same numbers, regardless of the executor.
    executor : object with submit(function, *args), optional
        A `concurrent.futures.Executor`, a Dask client's `get_executor()`, an
        `mpi4py.futures.MPIPoolExecutor`; by default a pool of fresh processes, for which a script
        needs `if __name__ == "__main__":`.
    workers : int, optional
        Processes of that pool, by default one a core; 1 is this process alone.
    resume : bool
        Resume the study in the file; more replicates may be asked for.
    overwrite : bool
        Replace the file.
    progress : bool
        Show a progress bar on standard error.
    error : float, pixel of the fine grid
        The rms error of the displacement over the field for which photons are counted.

    Returns
    -------
    NoiseStudy

    Raises
    ------
    InputError
        If a cell cannot be simulated, the file exists or holds another study, or a worker dies.
    KeyboardInterrupt
        After every finished frame was kept.

    References
    ----------
    Sun & Zhou, Section 4.2.

    Examples
    --------
    >>> import tempfile
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((41, 41)), bf.SourceCatalog.grid(3, 12.0, 1e3), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     study = noise_study(
    ...         model, [1e-3], [0.5, 50.0], replicates=2, path=f"{folder}/noise.ecsv", seed=1,
    ...         workers=1, progress=False)
    >>> rows = study.cells["parameter"] == "f_ux"
    >>> study.cells["background"][rows].tolist(), bool(np.diff(study.cells["bound"][rows]) > 0)
    ([0.5, 50.0], True)
    """
    check("noise study", replicates, method, noise)
    for name in SCALES:
        if getattr(nuisances, name):
            raise InputError(
                f"noise study: got {name}, expected sources as the model has them: fit without, or "
                "calibrate instead"
            )
    if psf_sigma and not isinstance(model.psf, GaussianPSF):
        raise InputError(
            "noise study: psf_sigma: got widths, expected none: only a Gaussian PSF's width is "
            "varied"
        )
    given: dict[str, Sequence[float]] = {
        "background": np.atleast_1d(background).tolist(),
        "flux": flux or [float(model.sources.flux.mean())],
        "sources": sources or [len(model.sources)],
        "psf_sigma": psf_sigma or [model.psf.sigma],
        "exposure": exposure or [1.0],
    }
    for name, values in (*given.items(), ("error", [error])):
        for value in values:
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"noise study: {name}: got {value}, expected a number > 0")
    wrong = [n for n in given["sources"] if n != round(n) or n > len(model.sources)]
    if wrong:
        raise InputError(
            f"noise study: sources: got {wrong[0]}, expected a number from 1 to the catalogue's "
            f"{len(model.sources)}"
        )
    number = math.prod(map(len, given.values()))
    if number > MOST_CELLS:
        raise InputError(
            f"noise study: got {number} combinations of noise levels, expected at most "
            f"{MOST_CELLS}: shorten the lists"
        )
    cells = tuple(
        dict(zip(VARIABLES, map(float, cell), strict=True))
        for cell in itertools.product(*given.values())
    )
    true = tuple(np.asarray(theta, dtype=np.float64).ravel().tolist())
    used = None if mask is None else np.array(mask, dtype=bool)
    study = _Levels(model, true, cells, method, noise, nuisances, prior, used, seed)
    for j in range(len(cells)):  # what cannot be simulated is said before the work
        posterior, truth = study.cell(j)
        if not np.isfinite(posterior.log_prob(truth)):
            raise InputError(
                "noise study: theta: got a distortion without prior density or that folds a "
                "source, expected a weaker one"
            )
    meta = {"study": "noise", "seed": seed, "method": method, "replicates": replicates}
    record = run(
        study,
        replicates * len(cells),
        path=path,
        meta=meta,
        executor=executor,
        workers=workers,
        resume=resume,
        overwrite=overwrite,
        progress=progress,
    )
    rows = record.columns
    photons = [photons_needed(*study.cell(j), error).flux for j in range(len(cells))]
    summary = summarise(study.names, len(study.theta), study.cells, rows, photons)
    whole = (summary["parameter"] == "theta") & (summary["frames"] > 1)
    message = (
        f"{rows['task'].size} frames, "
        f"{summary['failed'][summary['parameter'] == 'theta'].sum()} failed"
    )
    if whole.any():
        efficiency, coverage = summary["efficiency"][whole], summary["coverage_68"][whole]
        message += (
            f"; efficiency {efficiency.min():.2f} to {efficiency.max():.2f} of the Cramer-Rao bound"
        )
        message += f", 68 % intervals hold {coverage.min():.1%} to {coverage.max():.1%}"
    message += f"; {_photons_sentence(model, error, photons)}"
    return NoiseStudy(Path(path), study.names, rows, summary, message)


def _photons_sentence(model: ForwardModel, error: float, photons: Sequence[float]) -> str:
    """How bright sources have to be at the noise levels of a study."""
    low, high = (rounded(value) for value in (min(photons), max(photons)))
    flux = low if low == high else f"{low} to {high}"
    return f"for an error of {error:g} {pixel_unit(model)} rms: sources of {flux} photons"

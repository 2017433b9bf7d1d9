"""Studies on simulated frames.

What they compute, that they resume and run in parallel bit for bit, and that they catch errors.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from test_model import dense_image

import bayesfred as bf
from bayesfred.analysis import executor, sbc
from bayesfred.analysis import noise_study as noise_levels
from bayesfred.analysis.ecdf_bands import band, ecdf, points, uniformity
from bayesfred.analysis.executor import Answer
from bayesfred.analysis.field import field_points
from bayesfred.analysis.photons import laplace_error
from bayesfred.analysis.study_helpers import given, seeds
from bayesfred.errors import InputError
from bayesfred.io import tables
from bayesfred.reporting.studies import calibration_plot, noise_plot
from bayesfred.reporting.style import png

Floats = NDArray[np.float64]

TRUTH = (1e-3, -2e-3)


def tiny(**options: Any) -> bf.ForwardModel:
    """Four sources and two terms: a fit takes milliseconds."""
    distortion = bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[(0, 1, 0, 1)])
    return bf.ForwardModel(
        bf.Detector((31, 31)),
        bf.SourceCatalog.grid(2, 14.0, 1000.0),
        bf.GaussianPSF(2.0),
        distortion,
        **options,
    )


def levels(path: Path, **options: Any) -> bf.NoiseStudy:
    how: dict[str, Any] = {"replicates": 3, "seed": 1, "workers": 1, "progress": False, **options}
    return bf.noise_study(tiny(), TRUTH, [0.5, 50.0], path=path, **how)


def lines(path: Path) -> list[str]:
    """A study's rows in the order of the tasks."""
    rows = [line for line in path.read_text(encoding="utf-8").splitlines() if line[0].isdigit()]
    return sorted(rows, key=lambda line: int(line.split(",")[0]))


# --------------------------------------------------------------------------------------------------


def leaves(values: Floats, probability: float) -> bool:
    """Whether numbers' distribution leaves the band."""
    low, high = band(values.size, probability)
    return bool(np.any((ecdf(values) < low - 1e-12) | (ecdf(values) > high + 1e-12)))


@pytest.mark.parametrize("n", [10, 60, 150])
def test_band_holds_uniform_numbers_as_often_as_it_says(n: int) -> None:
    """2,000 sets: the Monte Carlo error of 5 % is 0.49 %.

    Counts are whole numbers, so that a band may hold more than it says.
    """
    numbers = np.random.default_rng(1).random((2000, n))
    outside = np.mean([leaves(values, 0.95) for values in numbers])
    assert 0.05 - (0.05 if n == 10 else 4 * 0.0049) < outside < 0.05 + 4 * 0.0049
    # the p-value says of each set whether it leaves the band of any probability
    p = np.array([uniformity(values) for values in numbers[:400]])
    assert [leaves(values, 0.95) for values in numbers[:400]] == (p < 0.05).tolist()
    assert np.mean(p < 0.5) == pytest.approx(0.5, abs=4 * 0.025 + (0.1 if n == 10 else 0.0))


def test_band_is_left_by_other_numbers() -> None:
    rng = np.random.default_rng(2)
    assert np.mean([leaves(rng.beta(1.5, 1.5, 250), 0.95) for _ in range(200)]) > 0.8
    assert uniformity(rng.beta(2.0, 2.0, 250)) < 1e-4 < uniformity(rng.random(250))


def test_band_of_one_point_is_binomial() -> None:
    """Two numbers have one point, 1/2: the band is that of a binomial count."""
    assert points(2).tolist() == [0.5]
    low, high = band(2, 0.95)
    assert (low[0], high[0]) == (0.0, 1.0)
    assert uniformity(np.array([0.1, 0.2])) == pytest.approx(0.5)


# --------------------------------------------------------------------------------------------------


def everything(model: bf.ForwardModel, noise: Any, **options: Any) -> bf.Posterior:
    nuisances = bf.Nuisances(**{"flux": "scale", "offset": True, "psf_sigma": True, **options})
    return bf.Posterior(model, model.expected_counts(TRUTH, 2.0), noise=noise, nuisances=nuisances)


def test_simulated_frame_is_that_of_the_parameters() -> None:
    model = tiny(tolerance=0.0)
    posterior = everything(model, bf.BackgroundNoise())
    params = np.array([*TRUTH, 1e-12, 1.1, 0.4, -0.3, 1.8])
    named = dict(zip(posterior.parameter_names, params, strict=True))
    frame = posterior.simulate(params, np.random.default_rng(1))
    assert frame == pytest.approx(
        dense_image(model, named, 1.1 * model.sources.flux), rel=1e-9, abs=1e-9
    )


def test_simulated_background_and_noise() -> None:
    """Means of 2,000 frames: 4 standard errors a pixel are exceeded by chance in 6 of 100,000."""
    posterior = everything(
        tiny(),
        bf.PoissonNoise(1.5),
        flux="fixed",
        offset=False,
        psf_sigma=False,
        background_order=1,
    )
    params = np.array([*TRUTH, 3.0, 1.0, -0.5])
    rng = np.random.default_rng(2)
    frames = np.array([posterior.simulate(params, rng) for _ in range(2000)])
    mean = posterior.expected_counts(params)
    z = (frames.mean(axis=0) - mean) / np.sqrt((mean + 1.5**2) / 2000)
    assert np.mean(z**2) == pytest.approx(1.0, abs=4 * np.sqrt(2.0 / z.size))
    assert np.abs(z).max() < 5.5


@pytest.mark.slow
def test_simulated_fluxes_and_shifts_have_their_priors() -> None:
    """One source, whose centroid scatters as Student's t does, by tau.

    The total's mean is F and its variance F^2/2 + F, those of Gamma(2) and Poisson.
    """
    sources = bf.SourceCatalog([2.0], [-1.0], [1e6])
    model = bf.ForwardModel(bf.Detector((41, 41)), sources, bf.GaussianPSF(2.0), tiny().distortion)
    nuisances = bf.Nuisances("free", position_scatter=True)
    posterior = bf.Posterior(model, model.expected_counts((0.0, 0.0), 1.0), nuisances=nuisances)
    rng, n = np.random.default_rng(3), 2000
    frames = [posterior.simulate([0.0, 0.0, 1e-9, 0.5], rng) for _ in range(n)]
    total = np.array([np.sum(frame) for frame in frames if frame is not None])
    assert total.mean() == pytest.approx(1e6, abs=4 * 1e6 / np.sqrt(2 * n))
    assert total.std() == pytest.approx(
        1e6 / np.sqrt(2), rel=4 * np.sqrt((stats.gamma(2).stats("k") + 2) / (4 * n))
    )
    u = np.arange(-20.0, 21.0)
    across = np.array([np.sum(frame @ u) for frame in frames if frame is not None]) / total
    assert stats.kstest(across, stats.t(3, 2.0, 0.5).cdf).pvalue > 1e-4
    assert stats.kstest(across, stats.norm(2.0, 0.5).cdf).pvalue < 1e-4  # the negative control


def test_folded_and_negative_frames_are_none() -> None:
    posterior = everything(tiny(), bf.PoissonNoise(), flux="fixed", offset=False, psf_sigma=False)
    rng = np.random.default_rng(4)
    assert posterior.simulate([0.0, 0.0, 1.0], rng) is not None
    assert posterior.simulate([-0.2, 0.0, 1.0], rng) is None
    assert posterior.log_prob([-0.2, 0.0, 1.0]) == -np.inf
    assert posterior.simulate([0.0, 0.0, -1.0], rng) is None


def test_seeds_are_the_children_of_one() -> None:
    assert (
        seeds(5, 3).generate_state(4).tolist()
        == np.random.SeedSequence(5).spawn(4)[3].generate_state(4).tolist()
    )


def test_sources_are_the_brightest_and_spread() -> None:
    grid = bf.SourceCatalog.grid(3, 10.0, 1.0)
    assert noise_levels._spread(grid, 5).tolist() == [0, 2, 4, 6, 8]
    bright = bf.SourceCatalog(grid.x, grid.y, [1.0, 1, 1, 1, 1, 9, 1, 8, 1])
    assert noise_levels._spread(bright, 2).tolist() == [5, 7]


# --------------------------------------------------------------------------------------------------


def test_a_frame_of_a_noise_study_is_an_ordinary_fit(tmp_path: Path) -> None:
    study = levels(tmp_path / "n.ecsv")
    model, k = tiny(), 3  # the second replicate of the second level
    for_frame, _ = seeds(1, k).spawn(2)
    counts = bf.simulate(model, TRUTH, 50.0, seed=for_frame)
    template = bf.Posterior(model, model.expected_counts(TRUTH, 50.0))
    posterior = bf.Posterior(model, counts, prior=template.prior)
    estimate = bf.find_map(posterior)
    bound = np.linalg.inv(posterior.fisher([*TRUTH, 50.0]))
    rows = study.replicates
    assert (rows["replicate"][k], rows["background"][k], rows["message"][k]) == (1, 50.0, "")
    for j, name in enumerate(("f_ux", "g_vy", "background")):
        assert rows[f"{name}.truth"][k] == (*TRUTH, 50.0)[j]
        assert rows[f"{name}.estimate"][k] == estimate.params[j]
        assert rows[f"{name}.sd"][k] == pytest.approx(np.sqrt(estimate.covariance[j, j]), rel=1e-12)
        assert rows[f"{name}.bound"][k] == pytest.approx(np.sqrt(bound[j, j]), rel=1e-9)
        z = ((*TRUTH, 50.0)[j] - estimate.params[j]) / np.sqrt(estimate.covariance[j, j])
        assert rows[f"{name}.pit"][k] == pytest.approx(stats.norm.cdf(z), rel=1e-9)
    off = estimate.params[:2] - TRUTH
    assert rows["theta.distance"][k] == pytest.approx(
        off @ np.linalg.inv(bound[:2, :2]) @ off, rel=1e-9
    )
    # f = c u x and g = c v y: the object at x = u / (1 - c u) is imaged at u
    points = field_points(template, np.array([*TRUTH, 50.0]))
    off = [
        p / (1.0 - estimate.params[j] * p) - p / (1.0 - TRUTH[j] * p)
        for j, p in enumerate((points.u, points.v))
    ]
    squares = 0.5 * (off[0] ** 2 + off[1] ** 2)[points.inside]
    assert rows["displacement.error"][k] == pytest.approx(np.sqrt(squares.mean()), rel=1e-6)
    predicted = laplace_error(posterior, np.array([*TRUTH, 50.0]), points)
    assert rows["displacement.predicted"][k] == pytest.approx(predicted, rel=1e-9)
    sources = model.expected_counts(TRUTH)
    estimated = model.expected_counts(estimate.params[:2])
    assert rows["lambda"][k] == pytest.approx(np.mean(counts - estimated), rel=1e-9)
    assert sources.shape == estimated.shape


def test_cells_are_sums_over_frames(tmp_path: Path) -> None:
    study = levels(tmp_path / "n.ecsv", replicates=6, flux=[500.0, 2000.0], exposure=[2.0])
    cells, rows = study.cells, study.replicates
    assert sorted(set(zip(cells["background"], cells["flux"], strict=True))) == [
        (0.5, 500),
        (0.5, 2000),
        (50, 500),
        (50, 2000),
    ]
    assert set(cells["parameter"]) == {"theta", "f_ux", "g_vy", "background"}
    mine = (rows["background"] == 50) & (rows["flux"] == 500)
    (at,) = np.flatnonzero(
        (cells["background"] == 50) & (cells["flux"] == 500) & (cells["parameter"] == "g_vy")
    )
    estimates = rows["g_vy.estimate"][mine]
    assert cells["frames"][at] == 6 == mine.sum()
    assert cells["bias"][at] == pytest.approx(estimates.mean() - TRUTH[1])
    assert cells["bias_error"][at] == pytest.approx(estimates.std(ddof=1) / np.sqrt(6))
    assert cells["scatter"][at] == pytest.approx(estimates.std(ddof=1))
    assert cells["width"][at] == pytest.approx(rows["g_vy.sd"][mine].mean())
    assert cells["efficiency"][at] == pytest.approx(cells["bound"][at] ** 2 / estimates.var(ddof=1))
    covered = np.abs(estimates - TRUTH[1]) < stats.norm.isf(0.16) * rows["g_vy.sd"][mine]
    assert cells["coverage_68"][at] == covered.mean()
    assert rows["background.truth"][mine].tolist() == [100.0] * 6  # exposure is a factor
    assert cells["lambda"][at] == pytest.approx(100.0, abs=4 * cells["lambda_error"][at])
    assert np.isnan(cells["displacement_rms"][at]) and np.isnan(cells["photons"][at])
    at -= 2  # all of theta
    squares = rows["displacement.error"][mine] ** 2
    root = np.sqrt(squares.mean())
    assert cells["displacement_rms"][at] == pytest.approx(root)
    error = squares.std(ddof=1) / np.sqrt(6) / (2.0 * root)
    assert cells["displacement_rms_error"][at] == pytest.approx(error)
    predicted = np.sqrt(np.mean(rows["displacement.predicted"][mine] ** 2))
    assert cells["displacement_predicted"][at] == pytest.approx(predicted)
    # the flux at which the error is 0.01 px, over the same background
    at_that = replace(tiny(), sources=bf.SourceCatalog.grid(2, 14.0, cells["photons"][at]))
    posterior = bf.Posterior(at_that, at_that.expected_counts(TRUTH, 100.0))
    truth = np.array([*TRUTH, 100.0])
    found = laplace_error(posterior, truth, field_points(posterior, truth))
    assert found == pytest.approx(0.01, rel=0.01)
    assert "for an error of 0.01 px rms: sources of" in study.message


def test_draws_agree_with_laplace(tmp_path: Path) -> None:
    """On bright sources the posterior is nearly normal.

    Means agree within the errors of 1,000 draws, widths within 10 %.
    """
    laplace, drawn = (
        levels(tmp_path / f"{m}.ecsv", method=m, replicates=2) for m in ("laplace", "mcmc")
    )
    for name in laplace.parameter_names:
        one, other = laplace.replicates, drawn.replicates
        assert np.all(
            np.abs(one[f"{name}.estimate"] - other[f"{name}.estimate"]) < 0.3 * one[f"{name}.sd"]
        )
        assert other[f"{name}.sd"] == pytest.approx(one[f"{name}.sd"], rel=0.1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"replicates": 1}, "replicates"),
        ({"method": "guess"}, "method"),
        ({"sources": [5]}, "sources"),
        ({"sources": [1.5]}, "sources"),
        ({"flux": [-1.0]}, "flux"),
        ({"exposure": [float("nan")]}, "exposure"),
        ({"error": 0.0}, "error"),
        ({"psf_sigma": [0.2]}, "psf"),
        ({"flux": [1.0] * 101, "exposure": [1.0] * 100}, "combinations"),
        ({"nuisances": bf.Nuisances("free", position_scatter=True)}, "position_scatter"),
        ({"workers": 0}, "workers"),
    ],
)
def test_studies_that_cannot_be_are_refused(
    tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        levels(tmp_path / "n.ecsv", **options)
    with pytest.raises(InputError, match="folds"):
        bf.noise_study(tiny(), (-0.2, 0.0), 1.0, path=tmp_path / "f.ecsv", seed=1)


def test_one_failed_cell_does_not_lose_the_others(tmp_path: Path) -> None:
    """A source of one photon over 1,000 counts a pixel determines nothing."""
    study = bf.noise_study(
        tiny(),
        TRUTH,
        1000.0,
        flux=[1.0, 1e5],
        replicates=2,
        path=tmp_path / "n.ecsv",
        seed=1,
        workers=1,
        progress=False,
    )
    whole = study.cells["parameter"] == "theta"
    assert study.cells["failed"][whole].tolist() == [2, 0]
    assert study.cells["frames"][whole].tolist() == [0, 2]
    assert np.isnan(study.cells["efficiency"][whole]).tolist() == [True, False]
    failed = study.replicates["message"][::2]
    assert all("cannot determine" in message for message in failed)
    assert "4 frames, 2 failed" in study.message
    parameters = bf.Posterior(tiny(), np.ones(tiny().detector.shape)).parameters
    assert png(noise_plot(study, parameters)).startswith(b"\x89PNG")


# --------------------------------------------------------------------------------------------------


def test_an_interrupted_study_goes_on_bit_for_bit(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.ecsv", tmp_path / "cut.ecsv"
    levels(whole)
    text = whole.read_bytes()
    rows = text.splitlines(keepends=True)
    cut.write_bytes(b"".join(rows[:-3]) + rows[-3][:40])  # killed in the middle of a row
    study = levels(cut, resume=True)
    assert cut.read_bytes() == text
    more = levels(cut, resume=True, replicates=4)  # an extension
    assert lines(cut)[:6] == lines(whole)
    assert more.replicates["task"].tolist() == list(range(8))
    fewer = levels(cut, resume=True)
    assert fewer.message == study.message


def test_files_of_others_are_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "n.ecsv"
    levels(path)
    before = path.read_bytes()
    for options, words in (
        ({}, "exists"),
        ({"resume": True, "seed": 2}, "another seed"),
        ({"resume": True, "flux": [10.0]}, "another counts, model, prior, grid"),
        ({"resume": True, "nuisances": bf.Nuisances("scale")}, "something else"),
    ):
        with pytest.raises(InputError, match=words):
            levels(path, **options)
    path.write_bytes(before.replace(b"\n0,", b"\n0,,", 1))
    with pytest.raises(InputError, match="damaged"):
        levels(path, resume=True)
    with pytest.raises(InputError, match="no folder"):
        levels(tmp_path / "absent" / "n.ecsv")
    levels(path, overwrite=True)
    assert path.read_bytes() == before


class Counting:
    """An executor that counts how often a study travels."""

    def __init__(self, pool: Any) -> None:
        self.pool, self.sent, self.studies = pool, 0, 0

    def submit(self, function: Callable[..., Any], /, *args: Any) -> Future[Any]:
        self.sent += 1
        self.studies += args[1] is not None
        return self.pool.submit(function, *args)


@pytest.mark.slow
def test_a_pool_gives_the_same_bits_and_gets_the_study_once_a_worker(tmp_path: Path) -> None:
    here, there = tmp_path / "here.ecsv", tmp_path / "there.ecsv"
    levels(here, replicates=10)
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        executor = Counting(pool)
        levels(there, replicates=10, executor=executor)
    assert lines(here) == lines(there)
    assert executor.studies <= 4 < 20 <= executor.sent


ORPHAN = """
import os, signal
from bayesfred.analysis import executor

if __name__ == "__main__":
    with executor._executor(None, 2) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_processes_of_a_pool_end_with_a_study_that_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "orphan.py"
    script.write_text(ORPHAN, encoding="utf-8")
    # returns when nobody has the pipes open any more
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert done.stdout.strip().isdigit()


class Forgetful:
    """Workers that join late: each of the first three tasks meets one that lacks the study."""

    def __init__(self) -> None:
        self.misses = 3

    def submit(self, function: Callable[..., Any], /, *args: Any) -> Future[Any]:
        if self.misses:
            executor._studies.clear()
        self.misses -= bool(self.misses)
        future: Future[Any] = Future()
        future.set_result(function(args[0], args[1] if self.misses == 0 else None, args[2]))
        return future


def test_a_worker_that_joins_late_is_given_the_study(tmp_path: Path) -> None:
    here, there = tmp_path / "here.ecsv", tmp_path / "there.ecsv"
    levels(here)
    levels(there, executor=Forgetful())
    assert lines(here) == lines(there)


class Dying:
    """An executor that breaks after a few answers, as a pool does whose process is killed."""

    def __init__(self) -> None:
        self.left = 3

    def submit(self, function: Callable[..., Any], /, *args: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.left -= 1
        if self.left < 0:
            future.set_exception(RuntimeError("a process was killed"))
        else:
            future.set_result(function(*args))
        return future


def test_what_is_finished_is_kept_when_workers_die(tmp_path: Path) -> None:
    path, whole = tmp_path / "n.ecsv", tmp_path / "whole.ecsv"
    with pytest.raises(InputError, match=r"a process was killed.*resume"):
        levels(path, executor=Dying())
    assert len(lines(path)) == 3
    levels(path, resume=True)
    levels(whole)
    assert lines(path) == lines(whole)


def test_answers_say_what_is_lacking_or_failed() -> None:
    assert executor.answer("unknown", None, 0)[1:3] == (None, None)

    class Broken:
        columns = ("x",)

        def contents(self) -> dict[str, str]:
            return {}

        def task(self, k: int) -> list[float]:
            raise ValueError("two\nlines")

    answer = executor.answer("broken", Broken(), 0)
    assert isinstance(answer, Answer)
    assert answer[1:] == (None, "ValueError: two\\nlines", False)


CLUSTER = """
import os, signal, sys, threading, time
from pathlib import Path
import bayesfred as bf
from distributed import Client, LocalCluster
from test_analysis_study import levels

if __name__ == "__main__":
    path = Path(sys.argv[1])
    workers = {"n_workers": 3, "threads_per_worker": 1}
    workers |= {"dashboard_address": None, "host": "127.0.0.1"}
    with LocalCluster(**workers) as cluster, Client(cluster) as client:
        pids = client.run(os.getpid)

        def kill():
            while not path.exists() or path.read_text().count("\\n") < 60:
                time.sleep(0.05)
            os.kill(list(pids.values())[0], signal.SIGKILL)
            print("killed", flush=True)

        thread = threading.Thread(target=kill)
        thread.start()
        levels(path, replicates=120, executor=client.get_executor())
        thread.join()
"""


@pytest.mark.long
def test_a_dask_cluster_that_loses_a_worker_gives_the_same_bits(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="Dask's distributed is not installed")
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER, encoding="utf-8")
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    done = subprocess.run(
        [sys.executable, script, tmp_path / "there.ecsv"],
        env=env,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "killed" in done.stdout
    levels(tmp_path / "here.ecsv", replicates=120)
    assert lines(tmp_path / "here.ecsv") == lines(tmp_path / "there.ecsv")


# --------------------------------------------------------------------------------------------------

TIGHT = 1.5e-4  # scale of a prior about as wide as what the frame says


def small(
    background: float = 2.0,
    flux: float = 1000.0,
    widen: float = 1.0,
    conserve_flux: bool = True,
    free: bool = False,
    psf_sigma: bool = False,
) -> bf.Posterior:
    """Nine sources and four terms, two of them with priors that matter."""
    distortion = bf.PolynomialDistortion(
        f_terms=[(1, 0, 1, 0), (1, 0, 0, 1)], g_terms=[(0, 1, 0, 1), (0, 1, 1, 0)]
    )
    model = bf.ForwardModel(
        bf.Detector((41, 41)),
        bf.SourceCatalog.grid(3, 12.0, flux),
        bf.GaussianPSF(2.0),
        distortion,
        conserve_flux=conserve_flux,
    )
    prior = {
        name: stats.norm(0.0, widen * TIGHT * np.sqrt(1000.0 / flux)) for name in ("f_vx", "g_uy")
    }
    prior["background"] = stats.gamma(4.0, scale=background / 4.0)
    if psf_sigma:
        prior["psf_sigma"] = stats.norm(2.0, 0.15)
    frame = model.expected_counts(np.zeros(4), background)
    return bf.Posterior(
        model, frame, prior=prior,
        nuisances=bf.Nuisances("free" if free else "fixed", psf_sigma=psf_sigma),
    )  # fmt: skip


@dataclass(frozen=True)
class TooSure(sbc._Calibration):
    """Error bars scaled by 0.9."""

    def drawn(self, posterior: bf.Posterior, seed: np.random.SeedSequence) -> Floats:
        draws = super().drawn(posterior, seed)
        mean = draws.mean(axis=0)
        return mean + 0.9 * (draws - mean)


WRONG: dict[str, Callable[[int], sbc._Calibration]] = {
    "a prior twice too wide": lambda seed: sbc._Calibration(
        small(), small(widen=2.0), "mcmc", seed
    ),
    "the determinant left out": lambda seed: sbc._Calibration(
        small(), small(conserve_flux=False), "mcmc", seed
    ),
    "error bars scaled by 0.9": lambda seed: TooSure(small(), small(), "mcmc", seed),
}

HOW: dict[str, Any] = {"executor": None, "resume": False, "overwrite": False, "progress": False}


def test_truth_is_ranked_among_the_draws(tmp_path: Path) -> None:
    posterior = small()
    study = sbc._Calibration(posterior, posterior, "mcmc", 1)
    row = dict(zip(study.columns, study.task(2), strict=True))
    for_truth, for_draws, for_ranks = seeds(1, 2).spawn(3)
    truth, _, counts = study.truth(np.random.default_rng(for_truth))
    assert row["f_ux.truth"] == truth[0]
    fit = given(posterior, counts)
    draws = study.drawn(fit, for_draws)
    assert row["draws"] == len(draws) > 150
    below = np.sum(draws[:, 0] < truth[0])
    assert below <= row["f_ux.pit"] * (len(draws) + 1) <= below + 1
    likelihood = fit.log_prob(draws) - fit.log_prior(draws)
    assert row["log_likelihood.mean"] == pytest.approx(likelihood.mean(), rel=1e-12)
    x, y = posterior.model.polynomial.object_position(truth[:4], 20.0, -20.0)
    corner = row["displacement_x(+20, -20).truth"], row["displacement_y(+20, -20).truth"]
    assert corner == pytest.approx((20.0 - float(x), -20.0 - float(y)), rel=1e-12)
    assert np.random.default_rng(for_ranks).random(1).size == 1


def test_fluxes_are_ranked_among_their_own_draws() -> None:
    """The true ones are those of the frame; draws know them to some 4 %, the prior to 71 %."""
    posterior = small(free=True)
    study = sbc._Calibration(posterior, posterior, "laplace", 1)
    row = dict(zip(study.columns, study.task(2), strict=True))
    _, fluxes, _ = study.truth(np.random.default_rng(seeds(1, 2).spawn(3)[0]))
    for s in (0, 4, 8):
        assert row[f"flux({s}).truth"] == fluxes[s]
        assert abs(row[f"flux({s}).mean"] - fluxes[s]) < 5.0 * row[f"flux({s}).sd"]
        assert row[f"flux({s}).sd"] < 0.3 * fluxes[s]


def test_draws_of_the_laplace_approximation_are_ranked_too(tmp_path: Path) -> None:
    """With hardly any background the normal approximation extends below zero.

    Draws there are left out.
    """
    dark = bf.simulation_based_calibration(
        small(background=0.001),
        replicates=3,
        method="laplace",
        path=tmp_path / "l.ecsv",
        seed=1,
        workers=1,
        progress=False,
    )
    assert dark.n == 3
    rows = tables.read_table(tmp_path / "l.ecsv").columns
    assert np.all((rows["draws"] > 50) & (rows["draws"] < 200))
    assert np.all(np.isfinite(rows["log_likelihood.mean"]))


@pytest.mark.statistics
def test_right_error_bars_are_found_right_and_wrong_ones_wrong(tmp_path: Path) -> None:
    """The verdict of the long run on few frames.

    Their sources are so bright that every frame shows a determinant that is missing.
    """
    right, wrong = (
        bf.simulation_based_calibration(
            small(flux=2e4), fitted=small(flux=2e4, conserve_flux=conserve), replicates=30,
            path=tmp_path / f"{conserve}.ecsv", seed=1, workers=1, progress=False,
        )
        for conserve in (True, False)
    )  # fmt: skip
    assert right.calibrated, right.message
    assert (right.n, right.n_failed, len(right.pit)) == (30, 0, 12)
    assert right.quantities["coverage_68_error"][0] == pytest.approx(np.sqrt(0.68 * 0.32 / 30))
    assert not wrong.calibrated
    assert "intervals of" in wrong.message
    for result in (right, wrong):
        assert png(calibration_plot(result, small().parameters)).startswith(b"\x89PNG")


def test_frames_without_a_posterior_are_no_calibration(tmp_path: Path) -> None:
    """Of sources of a photon nothing can be found."""
    result = bf.simulation_based_calibration(
        small(background=100.0, flux=1.0),
        replicates=3,
        path=tmp_path / "s.ecsv",
        seed=1,
        workers=1,
        progress=False,
    )
    assert not result.calibrated
    assert (result.n, result.n_failed) == (0, 3)
    assert "no posterior of 3 frames" in result.message
    assert all(column.size == 0 for column in result.quantities.values())
    assert {"uniformity", "coverage_68", "pull"} < set(result.quantities)
    assert png(calibration_plot(result, small().parameters)).startswith(b"\x89PNG")


def test_calibrations_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="fitted"):
        bf.simulation_based_calibration(
            small(), fitted=everything(tiny(), bf.PoissonNoise()), path=tmp_path / "s.ecsv", seed=1
        )
    folding = bf.Posterior(tiny(), np.ones((31, 31)), prior={"f_ux": stats.norm(-0.5, 0.01)})
    result = bf.simulation_based_calibration(
        folding, replicates=2, path=tmp_path / "s.ecsv", seed=1, workers=1, progress=False
    )
    assert "fold" in result.message


# --------------------------------------------------------------------------------------------------

RUN = """
[frame]
path = "frame.fits"
[catalogue]
path = "catalogue.csv"
[psf]
sigma = 2.0
[distortion]
f_terms = [[1, 0, 1, 0]]
g_terms = [[0, 1, 0, 1]]
[prior.background]
distribution = "gamma"
a = 4
scale = 0.5
[simulation]
shape = [31, 31]
background = 2.0
theta = {f_ux = 1e-3}
[simulation.grid]
side = 2
spacing = 14.0
flux = 1000
[study]
"""

STUDY = [sys.executable, "-m", "bayesfred", "study", "run.toml"]


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., bool]:
    """`bayesfred study` in a folder of its own, in this process, with some lines of [study]."""
    monkeypatch.chdir(tmp_path)

    def run(text: str, **options: Any) -> bool:
        Path("run.toml").write_text(RUN + text, encoding="utf-8")
        return bf.show.show_study(bf.commands.study("run.toml", **{"workers": 1, **options}))

    return run


def test_run_file(study: Callable[..., bool], capsys: pytest.CaptureFixture[str]) -> None:
    assert study("replicates = 4\nbackground = [1, 10]\n")
    assert "8 frames, 0 failed" in capsys.readouterr().out
    table = tables.read_table("chains/run.noise.ecsv")
    assert (table.meta["study"], table.columns["task"].size) == ("noise", 8)
    summary = tables.read_table("chains/run.noise.summary.ecsv")
    assert sorted(set(summary.columns["background"])) == [1.0, 10.0]
    assert Path("chains/run.noise.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InputError, match=r"run.noise.ecsv: exists"):
        study("replicates = 4\nbackground = [1, 10]\n")
    assert study("replicates = 5\nbackground = [1, 10]\n", resume=True)
    assert study("replicates = 10\n", kind="sbc")
    assert "calibrated: 10 frames" in capsys.readouterr().out
    assert len(tables.read_table("chains/run.sbc.summary.ecsv").columns["quantity"]) == 10
    assert not study(
        "replicates = 2\npath = 'faint.ecsv'\n[prior.f_ux]\ndistribution = 'norm'\nloc = -0.5\n",
        kind="sbc",
    )
    assert "not calibrated: no posterior of 2 frames (start: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "text", "words"),
    [
        ({"resume": True, "overwrite": True}, "", "got both"),
        ({}, "kind = 'other'\n", "study.kind"),
        ({}, "background = [0]\n", "study.background.0"),
        ({}, "sources = [5]\n", "run.toml: noise study: sources"),
        ({}, "path = '../n.ecsv'\n", "study.path"),
    ],
)
def test_bad_input_is_one_line(
    study: Callable[..., bool], options: dict[str, bool], text: str, words: str
) -> None:
    with pytest.raises(InputError, match=words) as refused:
        study(text, **options)
    assert "\n" not in str(refused.value)
    assert list(Path().rglob("*.ecsv")) == []


def test_a_study_needs_a_simulation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.toml").write_text(RUN[: RUN.index("[simulation]")], encoding="utf-8")
    with pytest.raises(InputError, match="simulation: no such section"):
        bf.commands.study("run.toml")


@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_that_is_not_there(study: Callable[..., bool]) -> None:
    """Whether Dask's distributed is installed or not: one line."""
    with pytest.raises(InputError, match=r"run.toml: --scheduler: ") as refused:
        study("", scheduler="nonsense")
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_an_interrupt_keeps_everything(
    study: Callable[..., bool], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A terminal's Ctrl-C, which goes to the pool's processes too."""
    (tmp_path / "run.toml").write_text(RUN + "replicates = 50000\n", encoding="utf-8")
    table = tmp_path / "chains" / "run.noise.ecsv"
    process = subprocess.Popen(
        [*STUDY, "--workers", "2"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while not (table.exists() and lines(table)) and process.poll() is None:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert said.splitlines()[-1].endswith("holds what is finished: resume it with --resume")
    n = len(lines(table))
    assert 0 < n < 50000
    assert study(f"replicates = {n + 2}\n", resume=True)
    assert f"{n + 2} frames" in capsys.readouterr().out


# --------------------------------------------------------------------------------------------------

N = 1000
CASES: dict[str, dict[str, Any]] = {
    "two counts a pixel": {},
    "a tenth of a count a pixel": {"background": 0.1, "flux": 200.0},
    "free fluxes": {"free": True},
    "the PSF's width": {"psf_sigma": True},
    "free fluxes and the PSF's width": {"free": True, "psf_sigma": True},
}


@pytest.mark.statistics
@pytest.mark.parametrize("case", CASES)
def test_error_bars_hold(tmp_path: Path, case: str) -> None:
    """Intervals and mean pulls of every parameter within three standard errors, and the verdict."""
    result = bf.simulation_based_calibration(
        small(**CASES[case]), replicates=N, path=tmp_path / "s.ecsv", seed=1, progress=False
    )
    assert result.calibrated, result.message
    assert result.n_failed == 0
    parameters = slice(0, 5)
    assert np.all(np.abs(result.quantities["coverage_68"][parameters] - 0.68) < 0.044)
    assert np.all(np.abs(result.quantities["coverage_95"][parameters] - 0.95) < 0.021)
    assert np.all(np.abs(result.quantities["pull"][parameters]) < 3.0 / np.sqrt(N))


@pytest.mark.statistics
@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_error_bars_are_caught(tmp_path: Path, wrong: str) -> None:
    result = sbc._calibrate(WRONG[wrong](1), N, path=tmp_path / "s.ecsv", workers=None, **HOW)
    assert not result.calibrated, result.message


def paper_levels(path: Path) -> bf.NoiseStudy:
    """The paper's frame and the coefficients of its Table 2 at eight backgrounds."""
    model = bf.ForwardModel(
        bf.Detector((505, 505)),
        bf.SourceCatalog.grid(9, 50.0, 1e5),
        bf.GaussianPSF(10.0),
        bf.PolynomialDistortion.mirrored(),
    )
    theta = [0.0, 2e-6, 0.0, -2e-6, 1e-6, 2e-6, 0.0, 3e-6, 0.0, 1e-6, 1e-6, -1e-6]
    return bf.noise_study(
        model,
        theta,
        np.geomspace(0.5, 500.0, 8).tolist(),
        replicates=50,
        path=path,
        seed=1,
        progress=False,
    )


def attains_the_bound(cells: dict[str, NDArray[Any]]) -> bool:
    """Efficiency over all levels from 0.9 to 1.1, which is five of its standard errors.

    At each level it is 1 within four of its own.
    """
    whole = cells["parameter"] == "theta"
    one, error = cells["efficiency"][whole], cells["efficiency_error"][whole]
    every = 1.0 / np.mean(1.0 / one)
    return bool(0.9 < every < 1.1 and np.all(np.abs(one - 1.0) < 4.0 * error))


def as_predicted(cells: dict[str, NDArray[Any]]) -> bool:
    """Whether the displacement's error is the predicted one at every level, within 4 of its own."""
    whole = cells["parameter"] == "theta"
    off = cells["displacement_rms"][whole] - cells["displacement_predicted"][whole]
    return bool(np.all(np.abs(off) < 4.0 * cells["displacement_rms_error"][whole]))


@pytest.mark.statistics
def test_the_papers_noise_study_attains_the_bound(tmp_path: Path) -> None:
    study = paper_levels(tmp_path / "n.ecsv")
    assert study.cells["failed"].sum() == 0
    assert attains_the_bound(study.cells), study.message
    coverage = {
        key: study.cells[key][study.cells["parameter"] == "theta"].mean()
        for key in ("coverage_68", "coverage_95")
    }
    # 400 frames of 12 coefficients, at worst all alike
    assert coverage["coverage_68"] == pytest.approx(0.68, abs=3 * np.sqrt(0.68 * 0.32 / 400))
    assert coverage["coverage_95"] == pytest.approx(0.95, abs=3 * np.sqrt(0.95 * 0.05 / 400))
    # estimates that scatter by a tenth more do not
    worse = {key: study.cells[key] / 1.1**2 for key in ("efficiency", "efficiency_error")}
    assert not attains_the_bound(study.cells | worse)
    assert as_predicted(study.cells)
    worse = {"displacement_rms": 1.2 * study.cells["displacement_rms"]}
    assert not as_predicted(study.cells | worse)

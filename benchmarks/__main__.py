"""How fast the package is: `python -m benchmarks` prints measures, ratios and their bounds.

Every row is a ratio within one run, of times the median of interleaved repetitions, so that it says
something about the code and little about the machine. The problem is the paper's frame: 505 x 505
pixels, 81 sources, sigma 10, tolerance 1e-8. `--full` adds how the cost grows with degree, PSF,
pixel response, frame and sources, and the memory, what others reach on the same posterior
(`benchmarks.peers`), and a large frame (`benchmarks.large`); rows without a bound are there to be
known.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
from rich.console import Console
from rich.table import Table

import bayesfred as bf
from bayesfred.imaging.psf import PSF
from bayesfred.sampling import sampler

THETA = np.array([0.0, 2e-6, 0.0, -2e-6, 1e-6, 2e-6, 0.0, 3e-6, 0.0, 1e-6, 1e-6, -1e-6])
SAMPLES = 960_000  # kernel samples of the paper's frame at this tolerance


def model(shape: tuple[int, int] = (505, 505), spacing: float = 50.0) -> bf.ForwardModel:
    sources = bf.SourceCatalog.grid(9, spacing, 1e5)
    return bf.ForwardModel(
        bf.Detector(shape), sources, bf.GaussianPSF(10.0), bf.PolynomialDistortion.mirrored()
    )


def ratio(
    work: Callable[[], object],
    unit: Callable[[], object],
    repetitions: int,
    clock: Callable[[], float] = time.thread_time,
) -> float:
    """Median time of `work` over that of `unit`, run in turn.

    It is the processor's time of this thread, unless another clock is given.
    """
    work(), unit()
    times = np.empty((repetitions, 2))
    for row in times:
        for k, function in enumerate((work, unit)):
            start = clock()
            function()
            row[k] = clock() - start
    above, below = np.median(times, axis=0)
    return float(above / below)


def with_threads(n: int, work: Callable[[], object]) -> Callable[[], object]:
    def run() -> object:
        numba.set_num_threads(n)
        return work()

    return run


def dense_image(m: bf.ForwardModel) -> np.ndarray:
    """Every pixel of every source in plain NumPy."""
    u, v = m.detector.pixel_centres()
    u, v = u[None, :], v[:, None]
    out = np.zeros(m.detector.shape)
    for x, y, flux in zip(m.sources.x, m.sources.y, m.sources.flux, strict=True):
        f, g = m.distortion.displacement(THETA, u, v, x, y)
        size = np.abs(m.distortion.determinant(THETA, u, v, x, y))
        r2 = (u - x + f) ** 2 + (v - y + g) ** 2
        out += flux * size * np.exp(-r2 / 200.0) / (200.0 * np.pi)
    return out


def share(run: Callable[[], bf.Chain]) -> tuple[float, bf.Chain]:
    """Share of a run's time that saving it takes, and what it leaves."""
    write, spent = sampler.write_chain, 0.0

    def timed(*args: object) -> None:
        nonlocal spent
        start = time.perf_counter()
        write(*args)
        spent += time.perf_counter() - start

    sampler.write_chain = timed
    start = time.perf_counter()
    chain = run()
    total = time.perf_counter() - start
    sampler.write_chain = write
    return spent / total, chain


MEMORY = """
import re, numpy as np, bayesfred as bf

def peak():  # of this program alone: getrusage's begins with that of the one which started it
    return 1024 * int(re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read())[1])

def image(n, side):
    sources = bf.SourceCatalog.grid(side, 40.0, 1e5)
    distortion = bf.PolynomialDistortion.mirrored()
    model = bf.ForwardModel(bf.Detector((n, n)), sources, bf.GaussianPSF(10.0), distortion)
    return model.expected_counts(np.zeros(12))

image(101, 2)  # compiled code is loaded
before = peak()
frame = image(4096, 100)
print((peak() - before) / frame.nbytes)
"""


def growth(
    exp: Callable[[], object], posterior: bf.Posterior, truth: np.ndarray
) -> list[tuple[str, float, float | None]]:
    """The rows of `--full`."""
    m = posterior.model

    def image(
        shape: tuple[int, int], side: int, spacing: float, **detector: str
    ) -> Callable[[], object]:
        camera, sources = bf.Detector(shape, **detector), bf.SourceCatalog.grid(side, spacing, 1e5)
        grown = bf.ForwardModel(camera, sources, m.psf, m.distortion)
        return lambda: grown.expected_counts(np.zeros(12))

    def stars(psf: PSF, pixel: str = "impulse") -> Callable[[], object]:
        camera = bf.Detector((512, 512), pixel=pixel)
        field = bf.ForwardModel(camera, bf.SourceCatalog.grid(20, 25.0, 1e5), psf, m.distortion)
        return lambda: field.expected_counts(THETA)

    rows: list[tuple[str, float, float | None]] = []
    for degree in (2, 3, 4, 5):
        terms = bf.PolynomialDistortion.full_polynomial(degree)
        deep = bf.ForwardModel(m.detector, m.sources, m.psf, terms)
        value = ratio(lambda deep=deep, n=terms.n_terms: deep.expected_counts(np.zeros(n)), exp, 20)
        rows.append((f"expected counts, every term to degree {degree} / np.exp", value, None))
    plain, x, moffat = np.zeros(12), np.arange(-240, 241) / 4.0, bf.MoffatPSF(23.5, 3.0)
    sampled = bf.SampledPSF(m.psf.density(x, x[:, None]), 4)
    for name, psf, tolerance in (
        ("Moffat", moffat, float(moffat.density(60.7, 0.0) / moffat.peak)),
        ("sampled", sampled, 1e-8),
    ):
        other = bf.ForwardModel(
            m.detector, m.sources, psf, m.distortion, tolerance=tolerance
        )  # windows as the Gaussian's
        value = ratio(
            lambda other=other: other.expected_counts(plain), lambda: m.expected_counts(plain), 20
        )
        bound = 1.6 if name == "Moffat" else 3.0
        rows.append((f"expected counts, {name} PSF / Gaussian", value, bound))
    for sigma in (0.7, 1.4, 2.0):
        value = ratio(stars(bf.GaussianPSF(sigma), "box"), stars(bf.GaussianPSF(sigma)), 20)
        rows.append((f"box pixels / impulse, 400 stars of sigma {sigma:g}", value, 2.5))
    x = np.arange(-40, 41) / 4.0
    in_pixels = np.exp(-(x**2 + x[:, None] ** 2) / (2.0 * (1.4**2 + 1.0 / 12.0)))
    measured = stars(bf.MeasuredPSF(in_pixels[None], 4.0, 300.0))
    value = ratio(measured, stars(bf.GaussianPSF(1.4)), 20)
    rows.append(("measured PSF with its pixel / Gaussian impulse, sigma 1.4", value, 4.0))
    few = image((505, 505), 9, 40.0)  # every source's pixels are within the frame, here and below
    for n, side, repetitions in ((1365, 32, 10), (4096, 100, 5)):
        value = ratio(image((n, n), side, 40.0), few, repetitions) * 81 / side**2
        rows.append((f"{side**2} sources on {n} x {n} / 81 on 505 x 505, per source", value, 1.2))
    free = bf.Posterior(m, posterior.counts, nuisances=bf.Nuisances(flux="free"))
    best = bf.find_map(free, truth)
    walkers = np.random.default_rng(1).multivariate_normal(best.params, best.covariance, 16)
    fixed = with_threads(1, lambda: posterior.log_prob(walkers))
    for name, kind, bound in (
        ("as sampled", free.near(best.params, best.covariance), 2.0),
        ("anywhere", free, 3.0),
    ):
        value = ratio(with_threads(1, lambda kind=kind: kind.log_prob(walkers)), fixed, 10)
        rows.append((f"log-posterior, free fluxes {name} / fixed", value, bound))
    stars_at = half_seen()
    value = ratio(stars_at(1.0), stars_at(8.0), 10)
    rows.append(("log-posterior, 144 touching stars, one about to change place / none", value, 2.0))
    peak = subprocess.run(
        [sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True
    ).stdout
    rows.append(("peak memory of an image / the frame's bytes", float(peak), 4.0))
    return rows


def half_seen() -> Callable[[float], Callable[[], object]]:
    """Log-posteriors of 144 stars that touch and scatter, of one of which half is masked.

    They are evaluated at eight scatters, times a factor. At 1 the half-seen star's shift has two
    maxima, of which one ends.
    """
    rng, scatter, error = np.random.default_rng(1), 6e-4, 4e-3
    x, y = (each.ravel() for each in np.meshgrid(*[18.0 * np.arange(12) - 99.0] * 2))
    moved = 2.0 * scatter * rng.standard_normal((2, x.size))
    moved[:, 0] = 0.07, 0.05
    flux, lens = np.full(x.size, 2e5), bf.PolynomialDistortion.polynomial(2)
    detector = bf.Detector((216, 216))
    stars, wider = (
        bf.ForwardModel(detector, bf.SourceCatalog(*at, flux), bf.GaussianPSF(sigma), lens)
        for at, sigma in (((x, y), 1.6), ((x + moved[0], y + moved[1]), 1.62))
    )
    mean = wider.expected_counts(np.zeros(lens.n_terms), 500.0)
    sd = np.sqrt(mean + 17.0**2 + (error * (mean - 500.0)) ** 2)
    u, v = (each + 99.0 for each in detector.pixel_centres())
    away = np.hypot(u, v[:, None])
    posterior = bf.Posterior(
        stars,
        mean + sd * rng.standard_normal(mean.shape),
        noise=bf.PoissonNoise(17.0),
        nuisances=bf.Nuisances("free", position_scatter=True, model_error=True),
        mask=(away > 9.0) | ((u < 0.7) & (away < 8.0)),
    )
    known = {"background": 500.0, "model_error": error}
    params = np.array([[known.get(name, 0.0) for name in posterior.parameter_names]] * 8)

    def at(factor: float) -> Callable[[], object]:
        rows = params.copy()
        rows[:, posterior.parameter_names.index("position_scatter")] = (
            factor * scatter * np.geomspace(0.9, 1.6, 8)
        )
        return with_threads(1, lambda: posterior.log_prob(rows))

    return at


def calibration() -> Callable[[], object]:
    """Objects of a million points with their covariance, for a lens of 18 terms."""
    lens, rng = bf.PolynomialDistortion.polynomial(3), np.random.default_rng(1)
    reach = lens.largest_displacement(512.0, 512.0).max(axis=0)
    draws = np.hstack([rng.normal(size=(1000, lens.n_terms)) / reach, np.zeros((1000, 2))])
    corners = np.array([[-512.0, -512.0], [512.0, -512.0], [512.0, 512.0], [-512.0, 512.0]])
    known = bf.Calibration(
        lens, draws, bf.Detector((1024, 1024)), bf.GaussianPSF(1.0), 1.0, corners
    )
    u, v = rng.uniform(-500.0, 500.0, (2, 10**6))
    return lambda: known.to_object(u, v)


def main() -> int:
    m = model()
    posterior = bf.Posterior(m, bf.simulate(m, THETA, 5.0, seed=1))
    truth = np.append(THETA, 5.0)
    walkers = np.tile(truth, (32, 1))
    x, out = -20.0 * np.random.default_rng(1).random(SAMPLES), np.empty(SAMPLES)

    def exp() -> object:
        return np.exp(x, out=out)

    def with_noise(noise: object, *, near: bool) -> Callable[[], object]:
        noisy = bf.Posterior(m, bf.simulate(m, THETA, 5.0, seed=1, noise=noise), noise=noise)
        if near:
            noisy = noisy.near(truth, np.linalg.inv(noisy.fisher(truth)))
        return with_threads(1, lambda: noisy.log_prob(truth))

    pixels, side = np.random.default_rng(1), m.detector.shape
    flat, read_noises = pixels.uniform(0.5, 1.5, side), pixels.uniform(1.0, 3.0, side)
    # as of an sCMOS camera, whose noisiest pixels are a tail
    tail = np.where(pixels.random(side) < 0.05, pixels.uniform(2.0, 6.0, side), 0.0)
    scmos = np.maximum(1.1 * np.exp(pixels.normal(0.0, 0.25, side)), tail)

    # the same sources in four times the empty frame, their pixels within the smaller one too
    inner, outer = (
        bf.Posterior(e, bf.simulate(e, THETA, 5.0, seed=1))
        for e in (model(spacing=40.0), model((1010, 1010), 40.0))
    )
    many = model((505, 1010))
    doubled = bf.SourceCatalog(
        np.concatenate([m.sources.x - 252.0, m.sources.x + 252.0]),
        np.tile(m.sources.y, 2),
        np.tile(m.sources.flux, 2),
    )
    plain = np.zeros(12)
    twice = bf.ForwardModel(many.detector, doubled, m.psf, m.distortion)
    once = bf.ForwardModel(many.detector, m.sources, m.psf, m.distortion)

    def fit() -> bf.MapEstimate:
        return bf.find_map(posterior)

    folder = tempfile.TemporaryDirectory()

    def sample(estimate: bf.MapEstimate | None = None, steps: int | None = None) -> bf.Chain:
        path = Path(folder.name) / "chain.h5"
        return bf.sample(
            posterior,
            estimate or fit(),
            path=path,
            seed=1,
            steps=steps,
            overwrite=True,
            progress=False,
        )

    estimate = fit()
    # so many steps that neither burn-in nor the noise of the least of 26 numbers counts
    saving, chain = share(lambda: sample(estimate, 150))
    diagnostics = bf.diagnose(chain)
    least = min(min(diagnostics.ess_bulk.values()), min(diagnostics.ess_tail.values()))
    draws = float(np.prod(chain.chain.shape[:3]))
    one = with_threads(1, exp)
    rows: list[tuple[str, float, float | None]] = [
        (
            "expected counts / np.exp of as many samples",
            ratio(lambda: m.expected_counts(THETA, 5.0), exp, 40),
            1.3,
        ),
        (
            "log-posterior per walker / np.exp",
            ratio(with_threads(1, lambda: posterior.log_prob(truth)), one, 40),
            1.9,
        ),
        *(
            (
                f"log-posterior, {name}{how} / photon noise",
                ratio(
                    with_noise(noise, near=near),
                    with_threads(1, lambda: posterior.log_prob(truth)),
                    40,
                ),
                bound,
            )
            for near, how, bound in ((False, "", 1.5), (True, ", as `sample` evaluates it", 1.2))
            for name, noise in (
                ("read noise 0.5", bf.PoissonNoise(0.5)),
                ("read noise 2", bf.PoissonNoise(2.0)),
                ("a map of read noises", bf.PoissonNoise(read_noises)),
                ("a map below 1", bf.PoissonNoise(0.25 * read_noises)),
                ("a map around 1", bf.PoissonNoise(0.5 * read_noises)),
                ("a map of an sCMOS camera", bf.PoissonNoise(scmos)),
                ("a flat field", bf.FlatFieldNoise(bf.PoissonNoise(), flat)),
                ("flat field, read noise 2", bf.FlatFieldNoise(bf.PoissonNoise(2.0), flat)),
                ("flat field, a map", bf.FlatFieldNoise(bf.PoissonNoise(read_noises), flat)),
            )
        ),
        (
            "32 walkers, 2 threads / 1 thread",
            ratio(
                with_threads(2, lambda: posterior.log_prob(walkers)),
                with_threads(1, lambda: posterior.log_prob(walkers)),
                8,
                time.perf_counter,
            ),
            0.55,
        ),
        (
            "Fisher information / np.exp",
            ratio(with_threads(1, lambda: posterior.fisher(truth)), one, 10),
            20.0,
        ),
        (
            "MAP from a cold start / np.exp",
            ratio(with_threads(2, fit), exp, 3, time.perf_counter),
            500.0,
        ),
        ("likelihoods per effective draw", draws / least, 1.3),
        (
            "MAP and 1,000 effective draws / one dense NumPy image",
            ratio(with_threads(2, sample), lambda: dense_image(m), 3, time.perf_counter),
            2.0,
        ),
        ("saving / sampling, 150 steps", saving, 0.01),
        (
            "objects of 1,000,000 points with covariance / np.exp",
            ratio(with_threads(1, calibration()), one, 3),
            1200.0,
        ),
        (
            "twice the sources",
            ratio(lambda: twice.expected_counts(plain), lambda: once.expected_counts(plain), 20),
            2.1,
        ),
        (
            "four times the empty frame",
            ratio(lambda: outer.log_prob(truth), lambda: inner.log_prob(truth), 20),
            1.1,
        ),
    ]
    folder.cleanup()
    if "--full" in sys.argv[1:]:
        rows += growth(one, posterior, truth)
    table = Table(
        title=f"{estimate.n_evaluations} likelihoods to the maximum, {draws:.0f} for {least:.0f} "
        "effective draws"
    )
    for head in ("measure", "ratio", "bound", "met"):
        table.add_column(head, justify="left" if head == "measure" else "right")
    for name, value, bound in rows:
        is_met = "" if bound is None else "yes" if value <= bound else "no"
        table.add_row(name, f"{value:.3g}", "" if bound is None else f"{bound:g}", is_met)
    Console(width=None if sys.stdout.isatty() else 110).print(table)
    met = all(bound is None or value <= bound for _, value, bound in rows)
    if "--full" in sys.argv[1:]:  # programs of their own, for their memory's sake
        for name in ("peers", "large", "joint", "first_use", "report"):
            sys.stdout.flush()
            met &= (
                subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], check=False).returncode
                == 0
            )
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())

"""What other packages reach: `python -m benchmarks.peers`.

First on the same posterior, that of the paper's frame, with 13 parameters and Poisson counts. Then,
in `benchmarks.rivals`, other ways to the field: centroids, OpenCV, least squares.

Each peer is written as a careful user of that package would, in float64, vectorised and compiled,
evaluating every source on a stamp of the pixels where it exceeds 1e-8 of its peak:

- emcee's stretch move on NumPy;
- NumPyro's NUTS on JAX, with the posterior's covariance as dense mass matrix;
- scipy's least squares with finite differences, on 2 sqrt(n + 3/8), whose variance is one.

What they would have to find first is given to them: where the stars are imaged, and for sampling
the maximum and its covariance. Effective draws a second are likelihoods (gradients) a second on the
frame over likelihoods (gradients) per effective draw. The latter are counted on the Gaussian with
the posterior's covariance, which it is close to, because on the frame itself they would take an
hour; warm-up is left out. Effective draws are counted by one estimator, that of `diagnose`: of the
slowest parameter, the lesser of bulk and tail. This package's own rate is that of a whole `sample`,
the maximum and the checks included.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import emcee
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import optimize

import bayesfred as bf
from bayesfred.sampling.convergence import convergence

RADIUS = 63  # of a stamp, pixels: 6.1 sigma is 1e-8 of the peak
WALKERS = 32


class Stamps:
    """The posterior in plain arrays: what a user would write down from the paper."""

    def __init__(self, posterior: bf.Posterior, theta: np.ndarray) -> None:
        s, d = posterior.model.sources, posterior.model.distortion
        ny, nx = posterior.counts.shape
        u, v = d.image_position(theta, s.x, s.y)
        self.x, self.y, self.flux = s.x[:, None, None], s.y[:, None, None], s.flux[:, None, None]
        left = np.clip(np.rint(u + (nx - 1) / 2).astype(int) - RADIUS, 0, nx - 2 * RADIUS - 1)
        top = np.clip(np.rint(v + (ny - 1) / 2).astype(int) - RADIUS, 0, ny - 2 * RADIUS - 1)
        column = left[:, None] + np.arange(2 * RADIUS + 1)
        row = top[:, None] + np.arange(2 * RADIUS + 1)
        self.u, self.v = column[:, None, :] - (nx - 1) / 2, row[:, :, None] - (ny - 1) / 2
        self.place = row[:, :, None] * nx + column[:, None, :]
        self.counts = posterior.counts.ravel()
        self.variance = 2.0 * posterior.model.psf.sigma**2
        self.n = d.n_terms
        self.width = np.array([posterior.prior[name].std() for name in d.names])
        self.level = posterior.prior["background"].kwds.get(
            "scale", posterior.prior["background"].args[-1]
        )

    def stamps(self, theta, exp):  # type: ignore[no-untyped-def]  # of NumPy or of JAX
        """Expected counts of every source.

        The terms of `mirrored` are polynomials in u and v for each source.
        """
        x, y, u, v = self.x, self.y, self.u, self.v
        t = theta
        f = x * (u * (t[0] + t[2] * u + t[4] * x) + v * (t[1] + t[3] * v + t[5] * x))
        g = y * (u * (t[6] + t[8] * u + t[10] * y) + v * (t[7] + t[9] * v + t[11] * y))
        f_u, f_v = x * (t[0] + 2.0 * t[2] * u + t[4] * x), x * (t[1] + 2.0 * t[3] * v + t[5] * x)
        g_u, g_v = y * (t[6] + 2.0 * t[8] * u + t[10] * y), y * (t[7] + 2.0 * t[9] * v + t[11] * y)
        size = abs((1.0 + f_u) * (1.0 + g_v) - f_v * g_u)
        square = (u - x + f) ** 2 + (v - y + g) ** 2
        return self.flux * size * exp(-square / self.variance) / (np.pi * self.variance)

    def mean(self, params: np.ndarray) -> np.ndarray:
        """Expected counts of all pixels in a row."""
        out = np.bincount(self.place.ravel(), self.stamps(params, np.exp).ravel(), self.counts.size)
        return np.asarray(out + params[self.n])

    def log_prob(self, params: np.ndarray) -> float:
        """Log-posterior up to a constant."""
        if params[self.n] <= 0.0:
            return -np.inf
        mu = self.mean(params)
        prior = (
            -0.5 * np.sum((params[: self.n] / self.width) ** 2)
            - 0.5 * (params[self.n] / self.level) ** 2
        )
        return float(self.counts @ np.log(mu) - mu.sum() + prior)


def effective(chain: np.ndarray) -> float:
    """Effective draws of a chain of shape (n_ensembles, n_steps, n_walkers, d)."""
    _, bulk, tail = convergence(chain)
    return float(min(bulk.min(), tail.min()))


def seconds(work: Callable[[], object], repetitions: int = 1) -> float:
    """Median time."""
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def own(posterior: bf.Posterior) -> tuple[float, float]:
    """Seconds to the maximum, and effective draws a second."""
    drawn: list[bf.Chain] = []
    with tempfile.TemporaryDirectory() as folder:

        def sample() -> None:
            drawn.append(
                bf.sample(
                    posterior,
                    path=Path(folder) / "own.h5",
                    seed=1,
                    target_ess=5000,
                    overwrite=True,
                    progress=False,
                )
            )

        spent = seconds(sample)
    return seconds(lambda: bf.find_map(posterior), 3), effective(
        drawn[0].chain[:, drawn[0].burn_in :]
    ) / spent


def stretch(stamps: Stamps, estimate: bf.MapEstimate) -> float:
    """Effective draws a second of emcee as it comes; its move is the same for every covariance."""
    d, steps = estimate.params.size, 20_000
    sampler = emcee.EnsembleSampler(
        WALKERS, d, lambda z: -0.5 * np.sum(z**2, axis=1), vectorize=True
    )
    sampler.random_state = np.random.RandomState(1).get_state()
    sampler.run_mcmc(np.random.default_rng(1).standard_normal((WALKERS, d)), steps)
    share = effective(sampler.get_chain()[None]) / (steps * WALKERS)
    return share / seconds(lambda: stamps.log_prob(estimate.params), 10)


def nuts(stamps: Stamps, estimate: bf.MapEstimate, start: np.ndarray) -> tuple[float, float]:
    """Seconds to the maximum, and effective draws a second, of NumPyro on JAX.

    The maximum is found by scipy's L-BFGS-B from no distortion.
    """
    import jax
    import jax.numpy as jnp
    import numpyro
    from numpyro.infer import MCMC, NUTS

    numpyro.enable_x64()
    lower = np.linalg.cholesky(estimate.covariance)
    place, counts = jnp.asarray(stamps.place.ravel()), jnp.asarray(stamps.counts)

    def potential(z):  # type: ignore[no-untyped-def]
        params = estimate.params + lower @ z
        image = jnp.zeros(counts.size).at[place].add(stamps.stamps(params, jnp.exp).ravel())
        mu = jnp.maximum(image + params[stamps.n], 1e-9)
        prior = (
            0.5 * jnp.sum((params[: stamps.n] / stamps.width) ** 2)
            + 0.5 * (params[stamps.n] / stamps.level) ** 2
        )
        return jnp.sum(mu - counts * jnp.log(mu)) + prior

    gradient = jax.jit(jax.value_and_grad(potential))

    def cost(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = jax.block_until_ready(gradient(z))
        return float(value), np.asarray(slope)

    begin = np.linalg.solve(lower, start - estimate.params)
    cost(begin)  # compiles
    to_map = seconds(lambda: optimize.minimize(cost, begin, jac=True, method="L-BFGS-B"))
    draws = 4000
    kernel = NUTS(potential_fn=lambda z: 0.5 * jnp.sum(z**2), dense_mass=True)
    run = MCMC(
        kernel,
        num_warmup=500,
        num_samples=draws,
        num_chains=4,
        chain_method="vectorized",
        progress_bar=False,
    )
    d = estimate.params.size
    run.run(jax.random.PRNGKey(1), init_params=jnp.zeros((4, d)), extra_fields=("num_steps",))
    chain = np.asarray(run.get_samples(group_by_chain=True))[:, :, None]
    share = effective(chain) / float(run.get_extra_fields()["num_steps"].sum())
    return to_map, share / seconds(lambda: cost(np.zeros(d)), 10)


def least_squares(stamps: Stamps, start: np.ndarray) -> float:
    """Seconds to the maximum with scipy's least squares, derivatives by finite differences."""
    data = 2.0 * np.sqrt(stamps.counts + 0.375)
    scale = np.append(stamps.width, start[-1])

    def residuals(z: np.ndarray) -> np.ndarray:
        mu = stamps.mean(z * scale)
        return np.append(2.0 * np.sqrt(np.maximum(mu, 0.0) + 0.375) - data, z[:-1])

    return seconds(lambda: optimize.least_squares(residuals, start / scale))


def main() -> int:
    from benchmarks import rivals
    from benchmarks.__main__ import THETA, model

    m = model()
    posterior = bf.Posterior(m, bf.simulate(m, THETA, 5.0, seed=1))
    estimate = bf.find_map(posterior)
    stamps = Stamps(posterior, estimate.params[:-1])
    truth = np.append(THETA, 5.0)
    apart = (
        stamps.log_prob(truth)
        - stamps.log_prob(estimate.params)
        - (posterior.log_prob(truth) - estimate.log_prob)
    )
    if not abs(apart) < 1e-2:
        raise RuntimeError(f"the peers' posterior is another one: by {apart:.3g}")
    rows = [
        ("bayesfred", *own(posterior)),
        ("emcee's stretch move, NumPy", np.nan, stretch(stamps, estimate)),
    ]
    if find_spec("jax") and find_spec("numpyro"):
        rows.append(("NumPyro's NUTS, JAX", *nuts(stamps, estimate, posterior.start())))
    else:
        rows.append(
            ("NumPyro's NUTS, JAX: not installed, see the extra `benchmarks`", np.nan, np.nan)
        )
    rows.append(
        (
            "scipy's least squares, finite differences",
            least_squares(stamps, posterior.start()),
            np.nan,
        )
    )
    table = Table(title="13 parameters, 81 sources on 505 x 505 pixels")
    for head in (
        "posterior by",
        "seconds to the maximum",
        "effective draws a second",
        "bayesfred / this",
    ):
        table.add_column(head, justify="left" if head == "posterior by" else "right")
    for name, to_map, rate in rows:
        cells = (
            "" if np.isnan(value) else f"{value:.3g}" for value in (to_map, rate, rows[0][2] / rate)
        )
        table.add_row(name, *cells)
    Console(width=None if sys.stdout.isatty() else 110).print(table)
    rivals.main()
    best = np.nanmax([rate for _, _, rate in rows[1:]])
    return 0 if rows[0][2] >= 100.0 * best else 1


if __name__ == "__main__":
    sys.exit(main())

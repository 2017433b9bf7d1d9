"""Whether the maximum is found from counts alone: `python -m benchmarks.starts`.

It fits random problems.

Every problem is drawn from its own number: a grid of 7 x 7 to 15 x 15 stars or 30 to 300 stars at
random places, any of four sets of terms, a displacement at the field's corner of up to 1.5 times
the stars' spacing and at most 80 pixels, a tenth of the catalogue's stars missing from the frame
and as many spots that are in no catalogue. The fit is compared with the maximum found when the
search starts at the truth. Results go to a file, one line a problem: a run that was stopped goes on
where it was.

Fits are sigma-clipped, because no maximum of a posterior of all the spots is near the truth. The
one from the truth is clipped from the truth, too, and may leave out other spots where it is close.
The last column says how often the truth is as near to the maximum as error bars that hold promise
in 99.9 %. A truth that folds the frame is outside the prior, and not drawn.
"""

import argparse
import json
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy import linalg, optimize, stats

import bayesfred as bf
from bayesfred.optimize.newton import maximize

TERMS = {
    "paper": bf.PolynomialDistortion.paper(),
    "mirrored": bf.PolynomialDistortion.mirrored(),
    "pinhole": bf.PolynomialDistortion.pinhole(),
    "full_polynomial(3)": bf.PolynomialDistortion.full_polynomial(3),
}
METHODS = ("L-BFGS-B", "SLSQP", "trust-constr")
LARGEST_FRAME = 400


def draw(number: int) -> tuple[bf.Posterior, np.ndarray, dict[str, Any]]:
    """A problem: posterior, true parameters, and what it is like."""
    rng = np.random.default_rng([4, number])
    terms = list(TERMS)[number % 4]
    distortion = TERMS[terms]
    sigma = math.exp(rng.uniform(0.0, math.log(10.0)))
    grid = bool(rng.integers(2))
    side = float(rng.integers(7, 16)) if grid else math.sqrt(rng.integers(30, 301))
    spacing = rng.uniform(max(2.5 * sigma, 10.0), max(3.0 * sigma, min(60.0, LARGEST_FRAME / side)))
    half = 0.5 * (side - 1) * spacing
    if grid:
        x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-half, half, int(side))] * 2))
    else:
        x, y = rng.uniform(-half, half, (2, round(side**2)))
    flux = np.full(x.size, math.exp(rng.uniform(math.log(1e3), math.log(1e5))))
    if not grid:
        flux *= rng.lognormal(0.0, 0.7, x.size)
    background = math.exp(rng.uniform(math.log(0.01), math.log(100.0)))
    shape = (2 * math.ceil(half + 1.1 * spacing) + 1,) * 2
    detector = bf.Detector(shape)
    model = bf.ForwardModel(
        detector, bf.SourceCatalog(x, y, flux), bf.GaussianPSF(sigma), distortion
    )
    theta, moved = coefficients(model, half, rng.uniform(0.0, min(80.0, 1.5 * spacing)), rng)
    lost = rng.random(x.size) < 0.1
    n_extra = rng.binomial(x.size, 0.1)
    extra = (
        bf.SourceCatalog(*rng.uniform(-half, half, (2, n_extra)), rng.choice(flux, n_extra))
        if n_extra
        else None
    )
    free = bool(rng.random() < 0.2 and x.size <= 150 and spacing > 4.0 * sigma)
    real = bf.SourceCatalog(x[~lost], y[~lost], flux[~lost])
    mean = bf.ForwardModel(detector, real, model.psf, distortion).expected_counts(theta, background)
    if extra:
        mean = mean + bf.ForwardModel(detector, extra, model.psf, distortion).expected_counts(theta)
    posterior = bf.Posterior(
        model, rng.poisson(mean), nuisances=bf.Nuisances(flux="free" if free else "fixed")
    )
    light = float(np.median(flux))
    known = {
        "number": number,
        "terms": terms,
        "field": "grid" if grid else "random",
        "stars": x.size,
        "sigma": sigma,
        "spacing": spacing,
        "moved": moved,
        "background": background,
        "flux": light,
        "fluxes": "free" if free else "fixed",
        "frame": shape[0],
        "signal": light / math.sqrt(4 * math.pi * sigma**2 * background + light),
    }
    return posterior, np.append(theta, background), known


def coefficients(
    model: bf.ForwardModel, half: float, wanted: float, rng: np.random.Generator
) -> tuple[np.ndarray, float]:
    """Coefficients in a random ratio that move the field's corners without a fold.

    They move them by at most `wanted` pixels; also returns by how many.
    """
    d, s = model.distortion, model.sources
    fine = np.linspace(-half, half, 25)
    x, y = (axis.ravel() for axis in np.meshgrid(fine, fine))
    corner = np.hypot(x, y) > 0.999 * math.hypot(half, half)
    x, y = np.concatenate([x, s.x]), np.concatenate([y, s.y])
    corner = np.concatenate([corner, np.zeros(len(s), bool)])

    def displacement(theta: np.ndarray) -> float:
        with np.errstate(all="ignore"):
            u, v = d.image_position(theta, x, y)
            good = np.all(d.determinant(theta, u, v, x, y) > 0.1)
        return float(np.hypot(u - x, v - y)[corner].max()) if good else math.inf

    posterior = bf.Posterior(model, np.ones(model.detector.shape))
    scale = np.array([posterior.prior[name].std() for name in d.names])
    attempts = 0
    while True:
        attempts += 1
        if (
            attempts > 10
        ):  # so far hardly any distortion of these terms moves the corners without a fold
            wanted *= 0.9
        direction = scale * rng.standard_normal(d.n_terms)
        low, high = 0.0, 16.0
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (
                (middle, high) if displacement(middle * direction) <= wanted else (low, middle)
            )
        moved = displacement(low * direction)
        # else it folds before it moves the corners so far, or elsewhere in the frame
        if moved > 0.9 * wanted and np.isfinite(posterior.log_prob([*low * direction, 1.0])):
            return low * direction, moved


def compile_all() -> None:
    """Compile: fit a small problem with fixed and with free fluxes before any is timed."""
    detector, sources = bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4)
    for distortion in TERMS.values():
        model = bf.ForwardModel(detector, sources, bf.GaussianPSF(3.0), distortion)
        counts = bf.simulate(model, np.zeros(distortion.n_terms), 2.0, seed=1)
        for posterior in (
            bf.Posterior(model, counts),
            bf.Posterior(model, counts, nuisances=bf.Nuisances(flux="free")),
        ):
            maximize(posterior, posterior.start())


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


def scipys(posterior: bf.Posterior, method: str) -> np.ndarray:
    """Where one of scipy's optimisers ends from no distortion, with the exact gradient.

    It works in units of the priors' standard deviations.
    """
    origin = posterior.start()
    scale = np.array([p.prior.std() for p in posterior.parameters])

    def cost(z: np.ndarray) -> tuple[float, np.ndarray]:
        params = origin + scale * z
        value = -float(posterior.log_prob(params))
        # outside the prior's support a wall, which these methods can step back from
        return (
            (value, -scale * posterior.gradient(params))
            if math.isfinite(value)
            else (1e12, np.zeros(z.size))
        )

    result = optimize.minimize(
        cost, np.zeros(origin.size), method=method, jac=True, options={"maxiter": 200}
    )
    return np.asarray(origin + scale * result.x)


def solve(task: tuple[int, bool]) -> dict[str, Any]:
    """Fit a problem from counts alone, from the truth, and, if asked, by scipy's optimisers."""
    number, with_rivals = task
    posterior, truth, out = draw(number)
    (clipped, best), out["truth_seconds"] = timed(lambda: bf.reject_outliers(posterior, truth))
    (_, estimate), out["seconds"] = timed(lambda: bf.reject_outliers(posterior))

    def square(params: np.ndarray, reference: bf.MapEstimate) -> float:
        """Squared Mahalanobis distance over its 99.9 % quantile; infinite without a maximum."""
        sd = np.sqrt(np.diag(reference.covariance))
        d, correlation = (params - reference.params) / sd, reference.covariance / np.outer(sd, sd)
        length = float(d @ linalg.solve(correlation, d, assume_a="pos")) / stats.chi2.ppf(
            0.999, truth.size
        )
        return length if reference.at_maximum else math.inf

    out |= {"found": square(estimate.params, best), "truth": square(truth, estimate)}
    out |= {"message": estimate.message, "truth_message": best.message}
    for method in METHODS if with_rivals else ():
        params, seconds = timed(lambda method=method: scipys(clipped, method))
        out[method] = {"found": square(params, best), "seconds": seconds}
    return out


STRATA: dict[str, Callable[[dict[str, Any]], str]] = {
    "all": lambda row: "all",
    "terms": lambda row: row["terms"],
    "field": lambda row: row["field"],
    "fluxes": lambda row: row["fluxes"],
    "stars": lambda row: between(row["stars"], (30, 100, 200, 301)),
    "sigma": lambda row: between(row["sigma"], (1, 2, 5, 10)),
    "background": lambda row: between(row["background"], (0.01, 0.1, 1, 10, 100)),
    "moved / spacing": lambda row: between(row["moved"] / row["spacing"], (0, 0.5, 1, 1.5)),
    "spacing / sigma": lambda row: between(row["spacing"] / row["sigma"], (2.5, 4, 8, 60)),
}


def between(value: float, edges: tuple[float, ...]) -> str:
    k = min(int(np.searchsorted(edges, value, side="right")), len(edges) - 1)
    return f"{edges[k - 1]:g} to {edges[k]:g}"


def order(value: str) -> tuple[float, str]:
    return float(value.split()[0]) if " to " in value else 0.0, value


def table(rows: Iterable[dict[str, Any]]) -> Table:
    """Share of problems whose maximum is found, and the cost in units of a fit from the truth."""
    rows = list(rows)
    tried = sum(METHODS[0] in row for row in rows)
    out = Table(title=f"{len(rows)} problems, {tried} of them also by scipy's optimisers")
    for head in ("", "", "problems", "found", "cost", *METHODS, "truth"):
        out.add_column(head, justify="right" if head else "left")

    def share(squares: list[float]) -> str:
        return f"{100 * np.mean(np.array(squares) <= 1.0):.1f} %" if squares else ""

    for name, stratum in STRATA.items():
        for value in sorted({stratum(row) for row in rows}, key=order):
            part = [row for row in rows if stratum(row) == value]
            cells = [share([row["found"] for row in part])]
            alone, from_truth = (
                sum(row[key] for row in part) for key in ("seconds", "truth_seconds")
            )
            cells.append(f"{alone / from_truth:.2f}")
            cells += [
                share([row[method]["found"] for row in part if method in row]) for method in METHODS
            ]
            cells.append(share([row["truth"] for row in part]))
            out.add_row(name, value, str(len(part)), *cells)
    return out


def logarithm() -> Table:
    """The paper's Fig. 2c, with a background but no noise, fitted by least squares.

    The kernel is the paper's own.
    """
    detector, sources, psf = (
        bf.Detector((505, 505)),
        bf.SourceCatalog.grid(9, 50.0, 1e5),
        bf.GaussianPSF(10.0),
    )
    frame = bf.ForwardModel(
        detector, sources, psf, bf.LogDistortion(1e-5), conserve_flux=False
    ).expected_counts([], 5.0)
    out = Table(
        title="the paper's Fig. 2c; the paper's V is 2.8e-3, of a logarithmic frame of 3175 x "
        "3175 pixels binned to 127"
    )
    for head in ("terms", "V / flux^2", "how"):
        out.add_column(head)
    for name, distortion in (
        ("mirrored", TERMS["mirrored"]),
        ("full_polynomial(4)", bf.PolynomialDistortion.full_polynomial(4)),
    ):
        model = bf.ForwardModel(detector, sources, psf, distortion, conserve_flux=False)
        posterior = bf.Posterior(model, frame, noise=bf.BackgroundNoise())
        estimate = bf.find_map(posterior)
        residual = frame - posterior.expected_counts(estimate.params)
        out.add_row(name, f"{np.sum((residual / 1e5) ** 2):.2e}", estimate.message)
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=500)
    parser.add_argument(
        "--rivals", type=int, default=60, help="scipy's optimisers try this many of the problems"
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--output", type=Path, default=Path("starts.jsonl"), help="results, one line a problem"
    )
    options = parser.parse_args()
    os.environ.update(
        NUMBA_NUM_THREADS="1", OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1"
    )  # of the processes to come
    lines = options.output.read_text().splitlines() if options.output.exists() else []
    rows = {row["number"]: row for row in map(json.loads, lines)}
    tried = {k for k, row in rows.items() if k >= options.rivals or METHODS[0] in row}
    tasks = [(k, k < options.rivals) for k in range(options.problems) if k not in tried]
    console = Console(stderr=True)
    with (
        multiprocessing.get_context("spawn").Pool(options.processes, compile_all) as pool,
        options.output.open("a") as file,
    ):
        for row in track(
            pool.imap_unordered(solve, tasks),
            total=len(tasks),
            console=console,
            description="problems",
        ):
            file.write(json.dumps(row) + "\n")
            file.flush()
            rows[row["number"]] = row
        figure = pool.apply(logarithm)
    out = Console(width=None if sys.stdout.isatty() else 120)
    out.print(table(rows.values()))
    for row in rows.values():
        if not row["found"] <= 1.0:
            out.print(
                f"problem {row['number']}: {math.sqrt(row['found']):.1f} times too far: "
                f"{row['message']}"
            )
    out.print(figure)
    return 0


if __name__ == "__main__":
    sys.exit(main())

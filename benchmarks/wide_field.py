"""A wide field, from counts alone: `python -m benchmarks.wide_field [STARS]`.

2,300 stars on 2048 x 3072 pixels, or as many as are given on a part of that, at the same density.
A lens of order 5 moves them by up to 30 pixels, their coma grows outward, and there are twice as
many fainter stars that no catalogue has. Fluxes, the PSF's width and the scatter of positions are
free; the PSF that is fitted is a Gaussian without coma. Printed are the processor's seconds of the
search, compilation left out, and what it ends with: once of all pixels, once with outliers left
out.
"""

import math
import sys
import time

import numpy as np

import bayesfred as bf

STARS, SHAPE = 2300, (2048, 3072)
SIGMA, BACKGROUND = 1.4, 50.0  # pixel; counts a pixel
# share of a star's light, and by how much it trails outward at the frame's corner, pixel
COMA = ((0.7, 0.0), (0.2, 1.0), (0.1, 2.2))
BOUND = 30.0  # seconds


def draw(stars: int, seed: int) -> tuple[bf.Posterior, np.ndarray]:
    """The posterior, and the true coefficients."""
    rng = np.random.default_rng([6, seed])
    ny, nx = (round(side * math.sqrt(stars / STARS)) for side in SHAPE)
    lens, half = bf.PolynomialDistortion.polynomial(5), 0.5 * math.hypot(nx, ny)
    x, y = rng.uniform(-0.49 * nx, 0.49 * nx, stars), rng.uniform(-0.49 * ny, 0.49 * ny, stars)
    flux = np.minimum(500.0 * (1.0 + rng.pareto(0.8, stars)), 2e5)
    # every term moves the corner by 0.7 pixels or so, and the radial cubic ones by 25
    reach = lens.largest_displacement(0.5 * nx, 0.5 * ny).max(axis=0)
    theta = 0.7 * rng.standard_normal(lens.n_terms) / reach
    for name in ("f_x3", "f_xy2", "g_x2y", "g_y3"):
        theta[lens.names.index(name)] -= 25.0 / half**3
    parts = [
        (x * (1.0 + trail / half), y * (1.0 + trail / half), share * flux) for share, trail in COMA
    ]
    unknown = 2 * stars
    parts.append(
        (
            rng.uniform(-0.5 * nx, 0.5 * nx, unknown),
            rng.uniform(-0.5 * ny, 0.5 * ny, unknown),
            np.exp(rng.uniform(math.log(50.0), math.log(1000.0), unknown)),
        )
    )
    light = bf.SourceCatalog(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    detector, psf = bf.Detector((ny, nx), pixel="box"), bf.GaussianPSF(SIGMA)
    mean = bf.ForwardModel(detector, light, psf, lens).expected_counts(theta, BACKGROUND)
    model = bf.ForwardModel(detector, bf.SourceCatalog(x, y, flux), psf, lens)
    nuisances = bf.Nuisances(flux="free", psf_sigma=True, position_scatter=True)
    return bf.Posterior(model, rng.poisson(mean), nuisances=nuisances), theta


def main() -> int:
    stars = int(sys.argv[1]) if len(sys.argv) > 1 else STARS
    few, _ = draw(12, 1)
    few.gradient(few.start()), few.fisher(few.start())  # compiled before any time is taken
    posterior, theta = draw(stars, 1)
    within = True
    for search in (bf.find_map, lambda posterior: bf.reject_outliers(posterior)[1]):
        start = time.process_time()
        estimate = search(posterior)
        seconds = time.process_time() - start
        errors = np.sqrt(np.diag(estimate.covariance))[: theta.size]
        off = np.abs(estimate.params[: theta.size] - theta) / errors
        print(f"{stars} stars: {seconds:.0f} s (bound {BOUND:g}); {estimate.message}")
        print(f"coefficients off by {np.median(off):.1f} of their errors, at most {off.max():.1f}")
        within &= seconds <= BOUND
    return 0 if within else 1


if __name__ == "__main__":
    sys.exit(main())

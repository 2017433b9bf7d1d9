"""Calibrate a star tracker's lens on two frames of the night sky, and compare it with centroids.

    BAYESFRED_DATA=<folder with the frames> python examples/startracker.py

The frames are ESA's (Gustav Pettersson, CC BY-SA 3.0 IGO), from the test images of
https://github.com/esa/tetra3. Both are fitted as `bayesfred fit` does, into chains/. A lens makes
the four cubic terms x^3 and x y^2 of u, x^2 y and y^3 of v equal; they are printed in pixels at 512
pixels from the middle, as displacement of the star (minus the coefficient of f or g).

The exit code is 3 where a verdict is "not trustworthy". The model fits the counts, but the measured
PSF leaves 16 % of the light unexplained: the verdict says so.
"""

import csv
import sys
from pathlib import Path

import numpy as np

import bayesfred as bf
from bayesfred import settings
from bayesfred.io.paths import resolve

HERE = Path(__file__).parent
RUNS = ("startracker.toml", "startracker_alt40_azi135.toml")
CUBIC = ("f_x3", "f_xy2", "g_x2y", "g_y3")
CENTROIDS = (
    0.56,
    0.56,
    0.53,
    0.51,
)  # least squares on the centroids of all eight frames of the set
CENTROID_ERROR = 0.05  # of a single frame's radial coefficient
RADIUS = 512.0


def main() -> int:
    trustworthy = True
    for name in RUNS:
        run_file = HERE / name
        print(f"\n{name}")
        overwrite = "--overwrite" in sys.argv
        result = bf.commands.fit(run_file, overwrite=overwrite, say=print)
        trustworthy = bf.show.show_run(result) and trustworthy
        compare(run_file, result.chain)
    return 0 if trustworthy else 3


def compare(run_file: Path, chain: bf.Chain) -> None:
    """Print the cubic terms beside those from centroids, and the stars' scatter about the fit."""
    names = list(chain.parameter_names)
    draws = chain.draws()
    mean_u, mean_v, error, scatter, ratio = star_scatter(run_file, chain)
    print("\ncubic terms, pixel at 512 pixels from the middle")
    print("term    posterior          centroids   difference / error")
    worst = 0.0
    for name, centroid in zip(CUBIC, CENTROIDS, strict=True):
        moved = -draws[:, names.index(name)] * RADIUS**3
        mean, sd = moved.mean(), moved.std(ddof=1)
        z = (mean - centroid) / np.hypot(sd, CENTROID_ERROR)
        worst = max(worst, abs(z))
        print(f"{name:6}  {mean:.3f} +- {sd:.3f}    {centroid:.2f}        {z:+.1f}")
    tau = draws[:, names.index("position_scatter")]
    print(
        f"The frame's centroids lie {mean_u:+.3f}, {mean_v:+.3f} (+- {error:.3f}) pixel off this "
        "fit in the mean; singly,\n"
        f"{scatter:.3f} (rms along an axis), which is {ratio:.1f} times their errors from photon "
        "noise. The posterior knows. It\n"
        f"finds that the stars scatter by {tau.mean():.3f} +- {tau.std(ddof=1):.3f} pixel about "
        "the catalogue, puts each where\n"
        "it is, so that no star is left with a dipole, and widens the errors of the terms. Likely "
        "causes: proper motion\n"
        "since the catalogue's epoch, close pairs, the air's turbulence during a short exposure, "
        "and a PSF that is no\n"
        "Gaussian in the 1.5 pixels that it covers."
    )
    if worst < 3:
        print("Posterior and centroids agree within 3 errors.")
    else:
        print(
            "Posterior and centroids do not all agree: few of one frame's stars are in the "
            "corners that fix x^3 and y^3."
        )


def star_scatter(run_file: Path, chain: bf.Chain) -> tuple[float, float, float, float, float]:
    """How the stars' centroids lie about the fit.

    Mean along u and v with its error, root mean square per axis, pixel; and the latter in units of
    the centroids' errors.
    """
    run = settings.read_settings(run_file)
    catalogue = resolve(run.catalogue.path, run_file, must_exist=True)
    stars = read(catalogue, "hip", "x", "y")
    centroids = read(
        catalogue.with_name(catalogue.stem + "_centroids.csv"), "hip", "u", "v", "err_u", "err_v"
    )
    measured = {row[0]: row[1:] for row in centroids}
    rows = np.array([[x, y, *measured[hip]] for hip, x, y in stars if hip in measured])
    x, y, u, v, error_u, error_v = rows.T
    params = dict(zip(chain.parameter_names, chain.draws().mean(axis=0), strict=True))
    distortion = chain.posterior().model.distortion
    theta = [params[name] for name in distortion.names]
    f, g = distortion.displacement(theta, u, v, x, y)
    off = np.stack([u - (x - f + params["offset_x"]), v - (y - g + params["offset_y"])])
    error = np.stack([error_u, error_v])
    weight = error**-2.0
    mean_u, mean_v = np.sum(weight * off, axis=1) / np.sum(weight, axis=1)
    scatter = np.sqrt(np.sum(weight * off**2) / np.sum(weight))
    error_of_mean = scatter * np.sqrt(
        np.mean(np.sum(weight**2, axis=1) / np.sum(weight, axis=1) ** 2)
    )
    return mean_u, mean_v, error_of_mean, scatter, np.sqrt(np.mean((off / error) ** 2))


def read(path: Path, *columns: str) -> list[list[float]]:
    """Columns of a CSV file as numbers."""
    with path.open(newline="") as file:
        return [[float(row[column]) for column in columns] for row in csv.DictReader(file)]


if __name__ == "__main__":
    try:
        sys.exit(main())
    except bf.InputError as error:
        sys.exit(f"startracker: {error}")

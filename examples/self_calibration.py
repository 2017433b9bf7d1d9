"""A camera calibrated by nine dithered frames of stars that are in no catalogue (simulated).

    python examples/self_calibration.py    # a minute or two; writes self_calibration.png beside it

The camera has a scale of 1.004 on the axis, pixels that are not quite square, and cubic distortion
of up to 9 pixels. The frames share no code with the package: a star's light is the integral of a
Gaussian over every pixel. Stars are fitted as points wherever they are, so the comparison with the
truth needs no matching of catalogues: the nearest star is the one.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy import spatial, special

import bayesfred as bf
from bayesfred._typing import Floats

PICTURE = Path(__file__).with_suffix(".png")
SIDE, SIGMA, LEVEL = 400, 1.2, 20.0  # pixels, pixel, photons a pixel
AXIS = np.array([[1.004, 0.001], [0.0, 1.002]])  # scale and shear on the axis
CUBIC = 9.0 / 200.0**3  # pixel^-2
STEP, JITTER = 64.0, 6.0  # of the dithers, pixel
STARS = 700  # on the sky that the frames show
COMMANDED = 0.03  # pixel, error of the commanded pointings


def image(x: Floats) -> Floats:
    """Where objects at x, shape (n, 2), are imaged, pixel."""
    on_axis = x @ AXIS.T
    return on_axis * (1.0 + CUBIC * (on_axis**2).sum(axis=1, keepdims=True))


def render(images: Floats, fluxes: Floats) -> Floats:
    """Expected counts: every star's Gaussian integrated over the pixels."""
    edges = np.arange(SIDE + 1) - 0.5 * SIDE
    steps = [special.ndtr((edges - at[:, None]) / SIGMA) for at in images.T]
    columns, rows = (np.diff(step, axis=1) for step in steps)
    return LEVEL + (rows * fluxes[:, None]).T @ columns


def simulate(seed: int = 1) -> tuple[dict[str, Floats], Floats, Floats]:
    """Nine frames by name, their pointings and the stars' positions."""
    rng = np.random.default_rng(seed)
    half = 0.5 * SIDE + STEP + 20.0
    stars = rng.uniform(-half, half, (STARS, 2))
    fluxes = np.exp(rng.uniform(np.log(2e3), np.log(4e4), STARS))
    grid = STEP * np.array([(i, j) for j in (0, 1, -1) for i in (0, 1, -1)])
    pointings = grid + rng.uniform(-JITTER, JITTER, grid.shape) * (np.arange(9) > 0)[:, None]
    frames = {
        f"dither{k}": rng.poisson(render(image(stars + t), fluxes)).astype(np.float64)
        for k, t in enumerate(pointings)
    }
    return frames, pointings, stars


def compare(found: bf.SelfCalibration, stars: Floats) -> Floats:
    """Print how far positions and map are from the truth; residuals of the catalogue, (n, 2)."""
    # the linear terms are fixed at 0, so the truth's plane is taken to the same convention
    true = stars @ AXIS.T
    catalogue = np.stack([found.catalogue.x, found.catalogue.y], axis=1)
    _, nearest = spatial.cKDTree(true).query(catalogue)
    off = catalogue - true[nearest]
    sd = np.sqrt(np.einsum("sii->si", found.positions_covariance))
    chi2 = np.einsum("si,sij,sj->s", off, np.linalg.inv(found.positions_covariance), off)
    print(f"catalogue - truth: {rms(off):.4f} pixel rms, stated {rms(sd):.4f}")
    print(f"  within the 68 % ellipse: {np.mean(chi2 < 2.279):.1%} of {len(off)} stars")
    u, v = (p.ravel() for p in np.meshgrid(*[np.linspace(-190.0, 190.0, 20)] * 2))
    x, y, covariance = found.calibration().to_object(u, v)
    on_axis = np.stack([x, y], axis=1)
    back = on_axis * (1.0 + CUBIC * (on_axis**2).sum(axis=1, keepdims=True))
    map_sd = np.sqrt(np.einsum("sii->si", covariance))
    left = back - np.stack([u, v], axis=1)
    print(f"map - truth: {rms(left):.4f} pixel rms, {np.abs(left).max():.4f} at worst,", end=" ")
    print(f"stated {rms(map_sd):.4f}; uncorrected {rms(on_axis - np.stack([u, v], axis=1)):.2f}")
    return off


def rms(values: Floats) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def picture(found: bf.SelfCalibration, off: Floats, path: Path) -> None:
    """The stars with the frames, and the errors of their positions."""
    figure = Figure(figsize=(10.0, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    frames, sources = found.frames, found.sources
    points = left.scatter(sources["x"], sources["y"], c=sources["frames"], s=9, cmap="viridis")
    figure.colorbar(points, ax=left, label="frames that show it")
    for row in frames:
        corner = -0.5 * SIDE - row["pointing_x"], -0.5 * SIDE - row["pointing_y"]
        edge = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]) * SIDE + corner
        left.plot(*edge.T, color="0.6", lw=0.7)
    left.set(aspect="equal", xlabel="x (pixel)", ylabel="y (pixel)")
    left.set_title("Stars found, and the frames without distortion")
    sd = np.stack([sources["x_sd"], sources["y_sd"]], axis=1)
    order = np.argsort(sd[:, 0])
    right.plot(sd[:, 0], off[:, 0], ".", ms=4, label="x - truth")
    for times in (1.0, -1.0):
        right.plot(sd[order, 0], times * sd[order, 0], color="k", lw=0.8)
    right.plot([], [], color="k", lw=0.8, label="plus and minus one stated sd")
    right.set(xlabel="stated sd of x (pixel)", ylabel="error of x (pixel)", xlim=(0.0, None))
    right.set_title("Errors of the catalogue")
    right.locator_params(axis="x", nbins=5)
    right.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def main() -> None:
    frames, pointings, stars = simulate()
    detector, psf = bf.Detector((SIDE, SIDE), pixel="box"), bf.GaussianPSF(SIGMA)
    found = bf.self_calibrate(frames, detector, psf)
    print(found.message, "\n")
    found.parameters.pprint(max_lines=-1)
    found.frames.pprint(max_lines=-1, max_width=-1)
    off = compare(found, stars)
    picture(found, off, PICTURE)

    print("\nCommanded pointings, right to", COMMANDED, "pixel:")
    rng = np.random.default_rng(2)
    commanded = pointings + COMMANDED * rng.standard_normal(pointings.shape)
    known = bf.self_calibrate(
        frames, detector, psf, pointings=dict(zip(frames, commanded.tolist(), strict=True)),
        pointing_sd=COMMANDED,
    )  # fmt: skip
    print(known.message)
    table = known.parameters
    for name, true in zip(("f_x", "f_y", "g_x", "g_y"), (np.eye(2) - AXIS).ravel(), strict=True):
        row = table[list(table["name"]).index(name)]
        print(f"{name} = {row['value']:+.5f} +- {row['sd']:.5f} (truth {true:+.5f})")


if __name__ == "__main__":
    main()

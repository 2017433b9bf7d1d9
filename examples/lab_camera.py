"""A lab camera and a printed grid of dots: simulate the photograph, and compare with the truth.

    python examples/lab_camera.py simulate    # writes dots.png beside the run file
    python examples/lab_camera.py compare     # after bayesfred fit; reads chains/lab_camera.h5

The lens is an f-theta lens: an object point at radius R from the axis is imaged at the radius
f arctan(R / f), so that an image point at radius r shows f tan(r / f). That is barrel distortion,
3.5 % in the corners of the grid, and no polynomial. The photograph shares no code with the package:
the ink is computed where every sub-pixel looks on the target, then blurred, summed and drawn.

The target's plane is in pixels of the undistorted grid. The catalogue that the frame is indexed by
is an exact lattice too, so the grid's cells connect it to the truth without anything being fitted.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

import bayesfred as bf
from bayesfred._typing import Floats

try:
    import cv2
except ImportError:
    cv2 = None  # type: ignore[assignment]

HERE = Path(__file__).parent
CHAIN = Path("chains", "lab_camera.h5")
SHAPE = 330, 450  # rows, columns, pixel
ROWS, COLUMNS, PITCH, RADIUS = 9, 13, 32.0, 1.75  # of the grid and its dots, pixel
ANGLE, SHIFT = 3.0, (4.0, -3.0)  # of the target, degree and pixel
FOCAL_LENGTH = 700.0  # pixel
BLUR = 0.7  # of the lens, pixel
WHITE, INK = 2000.0, 0.85  # electrons where the lamp is brightest, share that ink keeps away
GAIN, PEDESTAL = 0.0625, 64  # e-/adu and adu
SUB, BORDER = 5, 6  # sub-pixels a side in each pixel; pixels that the blur needs around the frame
EDGE = 0.3  # pixel over which ink fades
FEW = 12  # points of a chi-square: fewer numbers than the distortion has


def to_target(u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Where image points (pixel from the middle) are on the target, in pitches from its middle."""
    angle = np.hypot(u, v) / FOCAL_LENGTH
    stretch = np.tan(angle) / np.maximum(angle, 1e-9)
    x, y = stretch * u - SHIFT[0], stretch * v - SHIFT[1]
    c, s = np.cos(np.radians(ANGLE)), np.sin(np.radians(ANGLE))
    return (c * x + s * y) / PITCH, (c * y - s * x) / PITCH


def simulate(path: Path, seed: int = 1) -> None:
    """Write the photograph as a 16-bit PNG file."""
    ny, nx = SHAPE
    v, u = ((np.arange(SUB * (n + 2 * BORDER)) + 0.5) / SUB - 0.5 * n - BORDER for n in SHAPE)
    u, v = np.meshgrid(u, v)
    column, row = to_target(u, v)
    aside = column - np.clip(np.rint(column), -(COLUMNS // 2), COLUMNS // 2)
    above = row - np.clip(np.rint(row), -(ROWS // 2), ROWS // 2)
    ink = np.clip(0.5 + (RADIUS - PITCH * np.hypot(aside, above)) / EDGE, 0.0, 1.0)
    lamp = 1.0 + 0.04 * u / nx - 0.08 * ((u - 30.0) ** 2 + v**2) / 280.0**2
    light = gaussian_filter(WHITE * lamp * (1.0 - INK * ink), BLUR * SUB)
    inside = light[SUB * BORDER : -SUB * BORDER, SUB * BORDER : -SUB * BORDER]
    expected = inside.reshape(ny, SUB, nx, SUB).mean(axis=(1, 3))
    electrons = np.random.default_rng(seed).poisson(expected)
    Image.fromarray((electrons / GAIN + PEDESTAL).astype(np.uint16)).save(path)


def compare(chain_file: Path) -> tuple[float, float]:
    """Print how a calibration differs from the truth.

    Returns the largest difference over the grid in standard deviations, and the chi-square of the
    differences at `FEW` points, two at each.
    """
    chain = bf.open_chain(chain_file)
    calibration = bf.Calibration.from_chain(chain)
    catalogue = chain.posterior().model.sources
    to_object = lattice(calibration, np.stack([catalogue.x, catalogue.y], axis=1))

    reach = np.abs(calibration.sources).max(axis=0)
    u, v = (p.ravel() for p in np.meshgrid(*(np.linspace(-r, r, 41) for r in reach)))
    column, row = to_target(u, v)
    on_grid = (np.abs(column) < COLUMNS // 2 - 0.1) & (np.abs(row) < ROWS // 2 - 0.1)
    u, v = u[on_grid], v[on_grid]
    truth = np.insert(np.stack(to_target(u, v), axis=1), 0, 1.0, axis=1) @ to_object
    x, y, covariance = calibration.to_object(u, v)
    off = np.stack([x, y], axis=1) - truth
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    moved = np.hypot(*(truth - np.stack([u, v], axis=1)).T)
    print(f"{len(u)} points of the grid, which the lens moves by up to {moved.max():.1f} pixel")
    print(f"calibration - truth: {rms(off):.4f} pixel rms, {np.abs(off).max():.4f} at worst")
    print(f"stated sd:           {rms(sd):.4f} pixel rms, {sd.max():.4f} at worst")
    print(f"difference / sd:     {rms(off / sd):.2f} rms, {np.abs(off / sd).max():.1f} at worst")

    few = np.linspace(0, len(u) - 1, FEW).astype(int)
    square = chi_square(calibration, u[few], v[few], truth[few])
    print(f"chi-square of the differences at {FEW} points: {square:.1f}, expected {2 * FEW}")
    show_opencv(calibration, u, v, truth)
    return float(np.abs(off / sd).max()), square


def lattice(calibration: bf.Calibration, objects: Floats) -> Floats:
    """The affine map from target to object plane, shape (3, 2), by the cells of the catalogue."""
    cells = np.rint(np.stack(to_target(*calibration.sources.T), axis=1))
    matrix, *_ = np.linalg.lstsq(np.insert(cells, 0, 1.0, axis=1), objects, rcond=None)
    return np.asarray(matrix)


def chi_square(calibration: bf.Calibration, u: Floats, v: Floats, truth: Floats) -> float:
    """Of all differences together: what is left of u - x + f and v - y + g at the truth."""
    design = calibration.distortion.design_matrix(u, v, *truth.T)  # (2, points, terms)
    theta, offset = calibration.draws[:, :-2], calibration.draws[:, -2:]
    left = np.stack([u, v], axis=1) - truth + np.einsum("apk,nk->npa", design, theta)
    left = (left - offset[:, None]).reshape(len(offset), -1)
    mean = left.mean(axis=0)
    return float(mean @ np.linalg.solve(np.cov(left, rowvar=False), mean))


def show_opencv(calibration: bf.Calibration, u: Floats, v: Floats, truth: Floats) -> None:
    """Undistort points with OpenCV's camera, and print how far off they are."""
    camera = calibration.to_opencv(focal_length=FOCAL_LENGTH)
    k1, k2, *_, k3 = camera["distortion_coefficients"]
    print(f"OpenCV: k1 {k1:.3f}, k2 {k2:.3f}, k3 {k3:.3f} (truth: -1/3, 1/5, -1/7, ...)")
    if cv2 is None:
        print("OpenCV is not installed: pip install opencv-python-headless")
        return
    pixels = np.stack(calibration.index(u, v), axis=1)[:, None]
    matrix, coefficients = camera["camera_matrix"], camera["distortion_coefficients"]
    rays = cv2.undistortPoints(pixels, matrix, coefficients, R=camera["rotation"].T)[:, 0]
    off = FOCAL_LENGTH * rays - truth
    print(
        f"cv2.undistortPoints - truth: {rms(off):.4f} pixel rms, {np.abs(off).max():.4f} at worst"
    )


def rms(values: Floats) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    if sys.argv[1:] == ["simulate"]:
        simulate(HERE / "dots.png")
    elif sys.argv[1:] == ["compare"]:
        try:
            compare(CHAIN)
        except bf.InputError as error:
            sys.exit(f"lab_camera: {error}")
    else:
        sys.exit(f"usage: python {sys.argv[0]} simulate | compare")

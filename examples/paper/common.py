"""What the tables and figures share: printed numbers, the paper's field, rows, pictures."""

import io
import math
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy import linalg, optimize

import bayesfred as bf

Floats = NDArray[np.float64]

HERE = Path(__file__).parent
PRINTED: dict[str, Any] = tomllib.loads((HERE / "printed.toml").read_text(encoding="utf-8"))

# Powers (i, j, m, n) of x, y, u, v.
TERMS = {
    "ux": (1, 0, 1, 0),
    "vx": (1, 0, 0, 1),
    "u2x": (1, 0, 2, 0),
    "v2x": (1, 0, 0, 2),
    "ux2": (2, 0, 1, 0),
    "vx2": (2, 0, 0, 1),
    "uvx": (1, 0, 1, 1),
    "u2x2": (2, 0, 2, 0),
    "v2x2": (2, 0, 0, 2),
    "uvx2": (2, 0, 1, 1),
}

# How the six columns of f in Tables 2 and 3 can be read; those of g likewise, in x or in y.
AS_PRINTED = ("ux", "vx", "u2x", "v2x", "ux2", "vx2")
ALTERNATIVE = ("u2x", "v2x", "ux", "vx", "ux2", "vx2")
COLUMNS = ("ux2", "vx2", "ux", "vx", "u2x", "v2x")


def read_as(columns: Sequence[str], g_in: str = "y") -> bf.PolynomialDistortion:
    """The distortion whose coefficients stand in these columns, those of f and then those of g."""
    f = [TERMS[name] for name in columns]
    return bf.PolynomialDistortion(f, [(j, i, m, n) for i, j, m, n in f] if g_in == "y" else f)


DISTORTION = read_as(COLUMNS)


def paper_model(distortion: Any = DISTORTION, psf_sigma: float | None = None) -> bf.ForwardModel:
    """The 505 x 505 frame of Fig. 1, with the kernel as printed, which does not conserve flux."""
    o = PRINTED["object"]
    sources = bf.SourceCatalog.grid(o["sources"], o["spacing"], o["flux"])
    psf = bf.GaussianPSF(psf_sigma or o["psf_sigma"])
    return bf.ForwardModel(
        bf.Detector(tuple(o["shape"])), sources, psf, distortion, conserve_flux=False
    )


def truth(table: str) -> Floats:
    """True coefficients of Table 2 or 3, pixel^(1 - degree)."""
    return np.array(PRINTED[table]["truth"]) * PRINTED[table]["unit"]


def least_squares(
    model: bf.ForwardModel, frame: Floats, start: ArrayLike
) -> tuple[Floats, Floats, float]:
    """The paper's fit of a frame without background: theta that minimises V, the residual image, V.

    V is the sum over pixels of squared residuals in units of a source's flux.
    """
    flux = model.sources.flux[0]
    start = np.asarray(start, dtype=float)

    def residual(theta: Floats) -> Floats:
        return np.asarray(((model.expected_counts(theta) - frame) / flux).ravel())

    def slopes(theta: Floats) -> Floats:
        return np.asarray((model.jacobian(theta) / flux).reshape(start.size, -1).T)

    theta = optimize.least_squares(
        residual, start, slopes, method="lm", x_scale="jac", ftol=1e-9, xtol=1e-9, gtol=1e-9
    ).x
    left = residual(theta)
    for _ in range(5):  # Gauss-Newton steps, as far as rounding lets them gain
        matrix = slopes(theta)
        scale = np.sqrt(np.sum(matrix**2, axis=0))
        step = theta - np.linalg.lstsq(matrix / scale, left)[0] / scale
        after = residual(step)
        if after @ after >= left @ left:
            break
        theta, left = step, after
    return theta, -left.reshape(frame.shape) * flux, float(left @ left)


def background_bound(model: bf.ForwardModel, theta: Floats, background: float) -> Floats:
    """Cramer-Rao covariance of theta where a background that is known alone makes noise."""
    jacobian = model.jacobian(theta).reshape(theta.size, -1)
    information = jacobian @ jacobian.T
    scale = 1.0 / np.sqrt(np.diag(information))
    return np.asarray(
        linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale) * background
    )


@dataclass
class Fit:
    """A posterior's maximum and standard deviations; from draws where there are some."""

    estimate: bf.MapEstimate
    sd: Floats
    chain: bf.Chain | None = None


def fit(
    posterior: bf.Posterior, quick: bool, name: str = "", near: Fit | None = None, **options: Any
) -> Fit:
    """Maximise, and unless it must be quick, draw: the chain file is kept while the program runs.

    `near` is a fit of a model with fewer terms, to begin from.
    """
    start = None
    if near and near.chain:
        known = dict(zip(near.chain.parameter_names, near.estimate.params, strict=True))
        start = [known.get(parameter, 0.0) for parameter in posterior.parameter_names]
    estimate = bf.find_map(posterior, start)
    laplace = np.sqrt(np.diag(estimate.covariance))
    if quick:
        return Fit(estimate, laplace)
    chain = bf.sample(
        posterior,
        estimate,
        path=Path(_chains().name) / f"{name}.h5",
        seed=1,
        progress=False,
        **options,
    )
    return Fit(estimate, chain.draws().std(axis=0, ddof=1), chain)


@cache
def _chains() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="bayesfred-paper-")


@dataclass
class Row:
    """One line of the table: a number that the paper prints, or that it lacks, and ours.

    `agrees` is None where the paper prints no number.
    """

    quantity: str
    printed: str
    ours: str
    agrees: bool | None
    why: str = ""


@dataclass
class Section:
    """A table or figure of the paper: what was done, rows, pictures."""

    title: str
    text: str
    rows: list[Row] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)
    wide: str = ""  # a table of its own, in Markdown


def measured(value: float, sd: float) -> str:
    """A value and its standard deviation, to two digits of the latter.

    >>> measured(1.97312, 0.0213)
    '1.973 ± 0.021'
    """
    places = max(0, 1 - math.floor(math.log10(sd)))
    return f"{round(value, places) + 0.0:.{places}f} ± {sd:.{places}f}"


def listed(values: ArrayLike, places: int) -> str:
    """Several numbers in one cell; -0 is 0."""
    return ", ".join(f"{value:.{places}f}" for value in np.round(values, places) + 0.0)


def small(value: float) -> str:
    """A number whose size alone matters: rounding decides its digits."""
    return f"about {value:.0e}"


def same(paper: float, ours: float, sd: float, rounding: float = 0.0) -> bool:
    """Whether two measurements, each with this standard deviation, agree within three of them."""
    return bool(abs(paper - ours) <= 3.0 * math.sqrt(2.0) * sd + rounding)


# --------------------------------------------------------------------------------------------------

FONT = {"fontsize": 8}


def panels(rows: int, columns: int, size: float = 2.5) -> tuple[Any, Any]:
    """A figure with a grid of axes for frames."""
    figure = matplotlib.figure.Figure(
        figsize=(size * columns + 0.8, size * rows + 0.5), dpi=90, layout="constrained"
    )
    return figure, figure.subplots(rows, columns, squeeze=False)


def name_axes(axes: Any, title: str, across: str, down: str) -> None:
    """Title and labels, small."""
    axes.set_title(title, **FONT)
    axes.set_xlabel(across, **FONT)
    axes.set_ylabel(down, **FONT)
    axes.tick_params(labelsize=7)


def show(
    axes: Any,
    image: Floats,
    title: str,
    *,
    step: float = 1.0,
    colours: str = "viridis",
    **scale: Any,
) -> Any:
    """Draw a frame, v downwards as in the paper, coordinates from the middle in fine pixels."""
    ny, nx = image.shape
    extent = (-0.5 * nx * step, 0.5 * nx * step, 0.5 * ny * step, -0.5 * ny * step)
    drawn = axes.imshow(
        image, extent=extent, cmap=colours, interpolation="nearest", aspect="equal", **scale
    )
    name_axes(axes, title, "u / pixel", "v / pixel")
    axes.label_outer()
    return drawn


def bar(drawn: Any, axes: Any, label: str, **options: Any) -> None:
    """The colours' scale beside one or several axes."""
    scale = drawn.figure.colorbar(drawn, ax=axes, pad=0.02, **options)
    scale.set_label(label, **FONT)
    scale.ax.tick_params(labelsize=7)
    scale.ax.yaxis.get_offset_text().set_fontsize(7)


def symmetric(*images: Floats) -> dict[str, float]:
    """One scale around zero for all of the images."""
    limit = max(float(np.abs(image).max()) for image in images)
    return {"vmin": -limit, "vmax": limit}


def save(figure: Any, name: str, folder: Path) -> str:
    """Write a picture with 256 colours, which makes it three times smaller."""
    drawn = io.BytesIO()
    figure.savefig(drawn)
    Image.open(drawn).convert("RGB").quantize(
        256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
    ).save(folder / name, optimize=True)
    return name

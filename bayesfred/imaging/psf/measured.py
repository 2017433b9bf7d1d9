"""A PSF that was measured on the images of a frame's sources, with its errors."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from bayesfred._typing import Floats, PathLike
from bayesfred.errors import InputError
from bayesfred.imaging.psf.field import field_powers, field_terms
from bayesfred.imaging.psf.gaussian import GaussianPSF
from bayesfred.imaging.psf.sampled import (
    MARGIN,
    MOST_SAMPLES,
    spline_profile,
)
from bayesfred.imaging.psf.spline_values import values_at_knots
from bayesfred.io import psf_images
from bayesfred.io.serialize import serializable

NORMALISED = 1e-9
CELLS = 201  # a side, by which the area above half the peak is counted


@serializable("measured_psf")
@dataclass(frozen=True, eq=False)
class MeasuredPSF:
    """An effective PSF, measured on a frame: the light that a pixel receives from a point source.

    The pixel's response is in it, so its model samples it at the pixels' centres
    (`Detector(pixel="impulse")`). It is a cubic spline in (a, b), the coordinates in which the
    distortion is taken out, and every coefficient is a polynomial of the source's position:

        p(a, b; x, y) = sum_t (x / r)^i (y / r)^j sum_kl c[t, l, k] B(a h - k) B(b h - l)

    with h samples per pixel and r the field's radius. Or it varies linearly between the nodes of a
    grid: then the further terms are the nodes' own (`field_terms`). Its constant term has unit
    volume, and the others have none, so it changes no flux. Weighted by the Gaussian of the same
    width its centroid is zero everywhere on the field, so it moves no source: what moves sources is
    the distortion.

    Parameters
    ----------
    coefficients : array_like, shape (terms, n, n), per square pixel
        The splines' coefficients [t, b, a], n odd; the terms 1, x, y, x^2, x y, y^2, ..., or 1 and
        those of the nodes, row by row.
    oversampling : float
        Samples per pixel.
    field_radius : float, pixel
        Unit of x and y.
    nodes : int
        Along each axis of the grid; 0 if there is none.
    draws : array_like, shape (k, terms, n, n), per square pixel, optional
        Coefficients drawn from the posterior of the PSF: its errors. With nodes, of the first term.
    determined : float
        How many numbers of it the counts determined.
    model_error : float
        Standard deviation, as a share of the light, of what this PSF leaves unexplained in the
        pixels that it was measured on.

    Raises
    ------
    InputError
        If the coefficients are not finite, their number is not that of a polynomial, or the PSF's
        volume is not positive.

    References
    ----------
    J. Anderson & I. King, "Toward high-precision astrometry with WFPC2. I.", PASP 112, 1360 (2000).

    Examples
    --------
    >>> x = np.arange(-20, 21) / 4
    >>> psf = MeasuredPSF(np.exp(-(x**2 + x[:, None] ** 2) / 2)[None], 4.0, 100.0)
    >>> psf.degree, round(psf.sigma, 1), round(float(psf.density(0.0, 0.0)), 2)
    (0, 1.0, 0.16)
    """

    coefficients: Floats
    oversampling: float
    field_radius: float
    nodes: int = field(default=0, kw_only=True, metadata={"since": 9})
    draws: Floats | None = field(default=None, kw_only=True)
    determined: float = field(default=0.0, kw_only=True)
    model_error: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        c = np.array(self.coefficients, dtype=np.float64)
        n = c.shape[-1] if c.ndim == 3 else 0
        terms = self.nodes**2 + 1 if self.nodes else len(field_powers(max(_degree(len(c)), 0)))
        if c.shape != (terms, n, n) or n % 2 == 0 or not 5 <= n <= MOST_SAMPLES:
            raise InputError(
                f"psf: coefficients: got shape {c.shape}, expected (terms, n, n) with 1, 3, 6, ... "
                f"terms, or one and the nodes, and n odd, 5 to {MOST_SAMPLES}"
            )
        volume = float(c[0].sum())
        if not (np.isfinite(c).all() and volume > 0.0):
            raise InputError("psf: coefficients: expected finite ones of a positive sum")
        if not (1.0 <= self.oversampling <= MOST_SAMPLES and 0.0 < self.field_radius < math.inf):
            raise InputError(
                f"psf: got oversampling {self.oversampling} and field_radius {self.field_radius}, "
                f"expected samples per pixel, 1 to {MOST_SAMPLES}, and a positive radius"
            )
        scale = float(self.oversampling) ** 2 / volume
        if abs(scale - 1.0) < NORMALISED:  # so that what was stored is read as it was
            scale = 1.0
        draws = None if self.draws is None else np.array(self.draws, dtype=np.float64) * scale
        drawn = (1 if self.nodes else terms, n, n)
        if draws is not None and (draws.shape[1:] != drawn or not np.isfinite(draws).all()):
            raise InputError(
                f"psf: draws: got shape {draws.shape}, expected (k, {', '.join(map(str, drawn))})"
                " of finite numbers"
            )
        object.__setattr__(self, "coefficients", c * scale)
        object.__setattr__(self, "draws", draws)
        object.__setattr__(self, "oversampling", float(self.oversampling))
        object.__setattr__(self, "field_radius", float(self.field_radius))
        object.__setattr__(self, "determined", float(self.determined))
        object.__setattr__(self, "model_error", float(self.model_error))

    has_pixel = True  # the pixel's response is part of this PSF

    @property
    def degree(self) -> int:
        """Degree of the polynomial by which it varies over the field."""
        return 0 if self.nodes else _degree(len(self.coefficients))

    @property
    def varies(self) -> bool:
        """Whether it varies over the field."""
        return len(self.coefficients) > 1

    @property
    def variation(self) -> str:
        """How it varies over the field, in words."""
        if not self.varies:
            return "the same all"
        between = f"between {self.nodes} x {self.nodes} nodes"
        return f"varying {between if self.nodes else f'with degree {self.degree}'}"

    @cached_property
    def peak(self) -> float:
        """Largest value at a knot, at the field's middle, per square pixel."""
        return float(values_at_knots(self.coefficients[0]).max())

    @cached_property
    def sigma(self) -> float:
        """Width of the Gaussian that exceeds half the peak in as large an area, pixel."""
        bright = np.argwhere(values_at_knots(self.coefficients[0]) >= 0.3 * self.peak)
        side = self.coefficients.shape[-1]
        low = bright.min(axis=0) - 1.5 - 0.5 * (side - 1)
        high = bright.max(axis=0) + 1.5 - 0.5 * (side - 1)
        b, a = np.linspace(low, high, CELLS).T / self.oversampling
        share = np.mean(self.density(a, b[:, None]) >= 0.5 * self.peak)
        area = share * np.prod(high - low) / self.oversampling**2
        return math.sqrt(float(area) / (2.0 * math.pi * math.log(2.0)))

    @property
    def core(self) -> tuple[float, float]:
        """See `PSF`."""
        return self.sigma, 3.0

    @property
    def profile(self) -> Any:
        """The PSF at the field's middle as the compiled loops need it."""
        scale = self.oversampling * self.sigma
        spline = np.pad(self.coefficients[0], MARGIN) / self.oversampling**2
        return spline_profile(scale**2, spline, scale, round(self.oversampling))

    def profile_of(self, x: Floats, y: Floats) -> Any:
        """The PSF of every source as the compiled loops need it."""
        one = self.profile
        if not self.varies:
            return one
        edges = [(0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN)]
        c = np.pad(self.coefficients, edges) / self.oversampling**2
        c = np.tensordot(self.terms(x, y), c, 1)
        return spline_profile(one.norm, c, one.scale, one.stride)

    def terms(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Floats:
        """The field's terms at positions on it (pixel), shape (n, terms)."""
        return field_terms(x, y, self.degree, self.field_radius, self.nodes)

    def support_radius(self, tolerance: float) -> float:
        """Distance from the middle beyond which p is below `tolerance` times its peak, pixel."""
        if tolerance == 0.0:
            return math.inf
        c = np.abs(self.coefficients).sum(axis=0)
        four = np.lib.stride_tricks.sliding_window_view(np.pad(c, MARGIN), (4, 4)).max(axis=(2, 3))
        j, i = np.nonzero(four >= tolerance * self.peak)
        half = 0.5 * (len(four) - 1)
        far = np.hypot(np.abs(i - half) + 0.5, np.abs(j - half) + 0.5).max(initial=0.0)
        return float(far / self.oversampling)

    def density(
        self, a: npt.ArrayLike, b: npt.ArrayLike, *, at: tuple[float, float] = (0.0, 0.0)
    ) -> Floats:
        """The PSF at (a, b), pixel from its middle; per square pixel.

        Parameters
        ----------
        a, b : array_like, pixel
        at : (float, float), pixel
            The source's position x, y on the field.

        Returns
        -------
        ndarray, the broadcast shape
        """
        c = np.tensordot(self.terms(*at), self.coefficients, 1)
        where = np.stack(np.broadcast_arrays(b, a)) * self.oversampling + 0.5 * (len(c) - 1)
        values = ndimage.map_coordinates(np.pad(c, MARGIN), where.reshape(2, -1) + MARGIN,
                                         prefilter=False)  # fmt: skip
        return np.asarray(values.reshape(where.shape[1:]))

    def write(self, path: PathLike, *, overwrite: bool = False, run: str | None = None) -> None:
        """Write the PSF with its errors as FITS.

        Parameters
        ----------
        path : path-like
        overwrite : bool
            Replace a file that exists.
        run : str, optional
            What the run that measured it is known by: `Chain.identity`.

        Raises
        ------
        InputError
            If the file exists or cannot be written.
        """
        arrays = {"coefficients": self.coefficients, "draws": self.draws}
        image = values_at_knots(self.coefficients[0])
        numbers = {
            "oversampling": self.oversampling, "field_radius": self.field_radius,
            "determined": self.determined, "model_error": self.model_error, "nodes": self.nodes,
        }  # fmt: skip
        psf_images.write_psf(path, image, arrays, numbers, overwrite=overwrite, run=run)

    @classmethod
    def read(cls, path: PathLike) -> Self:
        """Read a PSF that was written.

        Parameters
        ----------
        path : path-like

        Returns
        -------
        MeasuredPSF

        Raises
        ------
        InputError
            If it is no such file, or is damaged.
        """
        return cls(**psf_images.read_psf(path))

    def to_photutils(self, shape: tuple[int, int] | None = None) -> Any:
        """The PSF as a model of photutils, whose positions count from a frame's first pixel.

        It is sampled four times a pixel or more. One that varies over the field is sampled on a
        grid of positions, its nodes or as many as its degree asks for, between which photutils
        interpolates.

        Parameters
        ----------
        shape : (int, int), optional
            Of the frame, (ny, nx) pixels; needed of a PSF that varies.

        Returns
        -------
        photutils.psf.ImagePSF or photutils.psf.GriddedPSFModel

        Raises
        ------
        InputError
            If photutils is not installed, or the shape is missing.
        """
        if self.varies and shape is None:
            raise InputError("shape: got none, expected that of the frame: the PSF varies over it")
        ny, nx = shape or (1, 1)
        points = self.nodes or 2 * self.degree + 1
        columns, rows = (np.linspace(0.0, n - 1.0, points) if self.varies else np.zeros(1)
                         for n in (nx, ny))  # fmt: skip
        fine = max(4, math.ceil(self.oversampling))
        half = math.ceil(0.5 * self.coefficients.shape[-1] / self.oversampling * fine)
        x = np.arange(-half, half + 1) / fine
        positions = np.array([(u, v) for v in rows for u in columns])
        images = [
            self.density(x, x[:, None], at=(u - 0.5 * (nx - 1), v - 0.5 * (ny - 1)))
            for u, v in positions
        ]
        return psf_images.photutils_model(np.array(images), positions, fine)

    def drawn(self) -> "Iterator[MeasuredPSF]":
        """The PSFs that were drawn from its posterior, each without errors of its own."""
        for drawn in self.draws if self.draws is not None else ():
            every = np.concatenate([drawn, self.coefficients[len(drawn) :]])
            yield replace(self, coefficients=every, draws=None)


def _degree(terms: int) -> int:
    """Of the polynomial that has so many terms."""
    return round((math.sqrt(1.0 + 8.0 * terms) - 3.0) / 2.0)


@serializable("psf.measured")
@dataclass(frozen=True)
class PSFToMeasure(GaussianPSF):
    """The Gaussian from which a run measures the PSF of its frame.

    Parameters
    ----------
    sigma : float, pixel
        About the right width, which is fitted first.
    oversampling, degree, nodes : int
        As for `fit_psf`.

    Raises
    ------
    InputError
        If `sigma` is not positive, or another cannot be used (`check_choices`).

    Examples
    --------
    >>> PSFToMeasure(1.3, degree=2)
    PSFToMeasure(sigma=1.3, oversampling=4, degree=2, nodes=0)
    """

    oversampling: int = 4
    degree: int = 0
    nodes: int = field(default=0, metadata={"since": 9})

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choices(self.oversampling, self.degree, self.nodes)


@serializable("psf.file")
@dataclass(frozen=True)
class PSFFile:
    """A PSF that was measured on another frame and written to a file.

    Parameters
    ----------
    path : str
        FITS, as `MeasuredPSF.write` and `bayesfred fit` write it.

    Examples
    --------
    >>> PSFFile("run.psf.fits")
    PSFFile(path='run.psf.fits')
    """

    path: str


def check_choices(oversampling: int, degree: int, nodes: int) -> None:
    """Refuse choices with which no PSF can be measured.

    Parameters
    ----------
    oversampling, degree, nodes : int

    Raises
    ------
    InputError
        If they are no integers from 1 to 16, 0 to 6, and 2 to 32 or 0; or if neither the degree nor
        the number of nodes is 0.
    """
    for name, value, low, high in (
        ("oversampling", oversampling, 1, 16),
        ("degree", degree, 0, 6),
        ("nodes", nodes or 2, 2, 32),
    ):
        if not isinstance(value, int | np.integer) or not low <= value <= high:
            raise InputError(
                f"psf: {name}: got {value!r}, expected an integer from {low} to {high}"
            )
    if degree and nodes:
        raise InputError(
            f"psf: got degree {degree} and nodes {nodes}, expected one of them: the PSF varies as "
            "a polynomial or between nodes"
        )

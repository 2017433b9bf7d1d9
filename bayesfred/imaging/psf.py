"""Reference point spread functions: the p of the Fredholm model, normalised to unit volume.

Every kind has one width, `sigma`: that of the Gaussian with the same full width at half maximum,
FWHM = 2.355 sigma. Where inference leaves the PSF's width free, this is the parameter, and p widens
as a whole, p(a s, b s) s^2 with s the ratio of widths. `forward.py` samples PSFs through the
compiled loops; lengths are in pixels of the fine grid.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import numpy.typing as npt
from scipy import linalg, ndimage, special

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.kernels.psf_profiles import Gaussian, Moffat, Spline
from bayesfred.io.serialize import serializable

FWHM = math.sqrt(8.0 * math.log(2.0))  # of a Gaussian of unit width
LARGEST_BETA = 100.0  # beyond, (1 + x)^-beta loses digits, and is a Gaussian to 1 %
MOST_SAMPLES = 1001  # of a sampled PSF, a side
MARGIN = 4  # zeros around a spline's coefficients


@serializable("psf.gaussian")
@dataclass(frozen=True)
class GaussianPSF:
    """Circular Gaussian, p(a, b) = exp(-(a^2 + b^2) / 2 sigma^2) / (2 pi sigma^2).

    Parameters
    ----------
    sigma : float, pixel
        Standard deviation along each axis; the full width at half maximum is 2.355 sigma.

    Raises
    ------
    InputError
        If `sigma` is not a positive finite number.

    References
    ----------
    Sun & Zhou, Section 2.3 (the reference PSF of their simulations).

    Examples
    --------
    >>> round(GaussianPSF(10.0).peak, 9)
    0.001591549
    """

    sigma: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sigma) and self.sigma > 0):
            raise InputError(f"psf: sigma: got {self.sigma}, expected a positive width in pixels")
        object.__setattr__(self, "sigma", float(self.sigma))

    @property
    def peak(self) -> float:
        """Largest value of the PSF, per square pixel."""
        return 1.0 / (2.0 * math.pi * self.sigma**2)

    @property
    def core(self) -> tuple[float, float]:
        """Arguments of `Detector.quadrature`: the width that the peak's curvature gives, pixel, and the exponent of the wings."""
        return self.sigma, math.inf

    @property
    def profile(self) -> Gaussian:
        """The PSF of unit width as the compiled loops need it."""
        return Gaussian(1.0 / (2.0 * math.pi))

    def reach(self, tolerance: float) -> float:
        """Distance from the middle beyond which the PSF is below `tolerance` times its peak, pixel."""
        return self.sigma * math.sqrt(-2.0 * math.log(tolerance)) if tolerance > 0 else math.inf

    def density(self, a: npt.ArrayLike, b: npt.ArrayLike) -> Floats:
        """The PSF at (a, b), pixel from its middle; per square pixel."""
        return np.asarray(self.peak * np.exp(-0.5 * (np.square(a) + np.square(b)) / self.sigma**2))


@serializable("psf.moffat")
@dataclass(frozen=True)
class MoffatPSF:
    """Circular Moffat function, p(a, b) = (beta - 1) / (pi alpha^2) (1 + (a^2 + b^2) / alpha^2)^-beta.

    Its wings fall as a power and reach far: with beta 3 it is above 1e-8 of its peak within 21
    alpha. Beyond a tolerance t lies the part t^(1 - 1/beta) of the flux, which is not counted: 5e-6
    of it in this case.

    Parameters
    ----------
    fwhm : float, pixel
        Full width at half maximum, 2 alpha sqrt(2^(1/beta) - 1).
    beta : float
        Exponent of the wings: > 1, without which their flux has no bound, and at most 100. It tends
        to a Gaussian as beta grows.

    Raises
    ------
    InputError
        If `fwhm` is not a positive finite number, or `beta` is out of range.

    References
    ----------
    A. F. J. Moffat, "A theoretical investigation of focal stellar images in the photographic
    emulsion and application to photographic photometry", Astronomy & Astrophysics 3, 455 (1969).

    Examples
    --------
    >>> psf = MoffatPSF(fwhm=4.0, beta=3.0)
    >>> round(float(psf.density(2.0, 0.0) / psf.peak), 9), round(psf.sigma, 3)
    (0.5, 1.699)
    """

    fwhm: float
    beta: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.fwhm) and self.fwhm > 0):
            raise InputError(f"psf: fwhm: got {self.fwhm}, expected a positive width in pixels")
        if not 1.0 < self.beta <= LARGEST_BETA:
            raise InputError(
                f"psf: beta: got {self.beta}, expected 1 < beta <= {LARGEST_BETA:g}: use a "
                "Gaussian in place of larger ones"
            )
        object.__setattr__(self, "fwhm", float(self.fwhm))
        object.__setattr__(self, "beta", float(self.beta))

    @property
    def sigma(self) -> float:
        """Width of the Gaussian with the same full width at half maximum, pixel."""
        return self.fwhm / FWHM

    @property
    def alpha(self) -> float:
        """Radius of the core, pixel."""
        return 0.5 * self.fwhm / math.sqrt(math.expm1(math.log(2.0) / self.beta))

    @property
    def peak(self) -> float:
        """Largest value of the PSF, per square pixel."""
        return (self.beta - 1.0) / (math.pi * self.alpha**2)

    @property
    def core(self) -> tuple[float, float]:
        """Arguments of `Detector.quadrature`: the width that the peak's curvature gives, pixel, and the exponent of the wings."""
        return self.alpha / math.sqrt(2.0 * self.beta), self.beta

    @property
    def profile(self) -> Moffat:
        """The PSF of unit width as the compiled loops need it."""
        square = (self.alpha / self.sigma) ** 2
        return Moffat((self.beta - 1.0) / (math.pi * square), square, self.beta)

    def reach(self, tolerance: float) -> float:
        """Distance from the middle beyond which the PSF is below `tolerance` times its peak, pixel."""
        return (
            self.alpha * math.sqrt(tolerance ** (-1.0 / self.beta) - 1.0)
            if tolerance > 0
            else math.inf
        )

    def density(self, a: npt.ArrayLike, b: npt.ArrayLike) -> Floats:
        """The PSF at (a, b), pixel from its middle; per square pixel."""
        return np.asarray(
            self.peak * (1.0 + (np.square(a) + np.square(b)) / self.alpha**2) ** -self.beta
        )


@serializable("psf.sampled")
@dataclass(frozen=True, eq=False)
class SampledPSF:
    """A PSF of any shape, given by samples: the cubic spline through them, scaled to unit volume.

    The spline is twice continuously differentiable everywhere, falls to zero within two samples of
    the outermost ones, and is zero beyond. Samples may be negative, as measured ones are in their
    wings; their sum may not.

    Parameters
    ----------
    values : array_like, shape (n, n), any unit
        Samples [b, a] on a square grid, n odd, the PSF's middle in the middle.
    oversampling : float
        Samples per pixel.

    Attributes
    ----------
    values : ndarray, shape (n, n)
        As given, read-only.

    Raises
    ------
    InputError
        If the samples are not finite, their sum is not positive, or n is even, less than 3 or more
        than 1001; if `oversampling` is less than 1 or more than 1001.

    References
    ----------
    M. Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing
    Magazine 16, 22 (1999).

    Examples
    --------
    >>> x = np.arange(-48, 49) / 4
    >>> psf = SampledPSF(np.exp(-(x**2 + x[:, None] ** 2) / 8), oversampling=4)
    >>> round(psf.sigma, 2), round(float(psf.density(1.1, 0.3) / GaussianPSF(2.0).density(1.1, 0.3)), 5)
    (2.0, 1.0)
    """

    values: Floats
    oversampling: float

    def __post_init__(self) -> None:
        try:
            values = np.array(self.values, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(
                "psf: values: not numbers, expected samples on a square grid"
            ) from None
        n = len(values) if values.ndim == 2 else 0
        if values.shape != (n, n) or n % 2 == 0 or not 3 <= n <= MOST_SAMPLES:
            raise InputError(
                f"psf: values: got shape {values.shape}, expected (n, n) with n odd, 3 to "
                f"{MOST_SAMPLES}: cut or pad them so that "
                "the PSF's middle is in the middle"
            )
        if not np.isfinite(values).all():
            raise InputError(
                f"psf: values: got {np.sum(~np.isfinite(values))} that are not finite, expected "
                "numbers: fill them first"
            )
        if not 1.0 <= self.oversampling <= MOST_SAMPLES:
            raise InputError(
                f"psf: oversampling: got {self.oversampling}, expected samples per pixel, 1 to "
                f"{MOST_SAMPLES}"
            )
        with np.errstate(over="ignore", invalid="ignore"):
            total, scale = float(values.sum()), float(_coefficients(values).sum())
        if not (0.0 < total < math.inf and 0.0 < scale < math.inf):
            raise InputError(
                f"psf: values: got a sum of {total:.4g}, expected a positive one: subtract less "
                "background"
            )
        values.flags.writeable = False
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "oversampling", float(self.oversampling))

    @classmethod
    def measured(
        cls,
        counts: npt.ArrayLike,
        position: Sequence[float],
        half_width: int,
        *,
        background: float = 0.0,
        oversampling: int = 4,
    ) -> Self:
        """Measure the PSF on a spot that stands alone, near the axis where distortion vanishes.

        Whittaker and Shannon's interpolation in its finite form: a spot that is band-limited and
        dark at its window's border is the trigonometric polynomial through its pixels. Samples are
        exact for a Gaussian of sigma >= 2 pixels to 1e-7 of the peak, and the noise of the counts
        goes into them as it is. Of a frame that integrates over pixels the PSF is measured with the
        pixel in it: fit with impulse pixels, or take the pixel out of the frame first with
        `correct_sampling`.

        Parameters
        ----------
        counts : array_like, shape (ny, nx), counts
        position : (float, float), pixel
            Where the spot is, u and v from the frame's middle.
        half_width : int, pixel
            Of the window around it, which should hold all of the spot and nothing else.
        background : float, counts per pixel
            Level to subtract.
        oversampling : int
            Samples per pixel of the result.

        Returns
        -------
        SampledPSF
            Its `values` are counts per pixel.

        Raises
        ------
        InputError
            If the window is not within the frame, or holds no spot.

        References
        ----------
        Sun & Zhou, Section 2.3 and Fig. 5.

        Examples
        --------
        >>> import bayesfred as bf
        >>> model = bf.ForwardModel(
        ...     bf.Detector((65, 65)), bf.SourceCatalog([0.3], [-0.2], [1e4]), bf.GaussianPSF(2.0),
        ...     bf.PolynomialDistortion.mirrored())
        >>> psf = bf.SampledPSF.measured(model.expected_counts([0.0] * 12, 7.0), (0.3, -0.2), 14, background=7.0)
        >>> psf.values.shape, round(float(psf.density(0.0, 0.0) / model.psf.peak), 4)
        ((109, 109), 1.0)
        """
        frame = np.asarray(counts, dtype=np.float64)
        if frame.ndim != 2:
            raise InputError(f"counts: got shape {frame.shape}, expected two dimensions (ny, nx)")
        if operator.index(half_width) < 1 or operator.index(oversampling) < 1:
            raise InputError(
                f"psf: got half_width {half_width} and oversampling {oversampling}, expected both "
                "at least 1"
            )
        reach = math.floor(
            (half_width - 0.5) * oversampling
        )  # so that no sample lies outside of the window
        matrices, window = [], []
        for centre, size in zip(position, frame.shape[::-1], strict=True):
            place = centre + 0.5 * (size - 1)
            first = round(place) - half_width if math.isfinite(place) else -1
            if not 0 <= first <= size - 2 * half_width - 1:
                raise InputError(
                    f"psf: position: got {tuple(position)} with half_width {half_width}, expected "
                    "the window within the frame of "
                    f"{frame.shape[1]} x {frame.shape[0]} pixels from its middle"
                )
            n = 2 * half_width + 1
            samples = place + np.arange(-reach, reach + 1) / oversampling
            matrices.append(
                special.diric(2.0 * np.pi / n * (samples[:, None] - np.arange(first, first + n)), n)
            )
            window.append(slice(first, first + n))
        spot = frame[window[1], window[0]] - background
        return cls(matrices[1] @ spot @ matrices[0].T, oversampling)

    @cached_property
    def _spline(self) -> Floats:
        """The spline's coefficients in units of their sum, with zeros around them."""
        c = _coefficients(self.values)
        return np.pad(c / c.sum(), MARGIN)

    @cached_property
    def peak(self) -> float:
        """Largest sample, per square pixel."""
        return float(self.values.max() / _coefficients(self.values).sum() * self.oversampling**2)

    @cached_property
    def sigma(self) -> float:
        """Width of the Gaussian that exceeds half its peak in as large an area, pixel."""
        n = len(self.values)
        fine = (MOST_SAMPLES // n | 1) * n  # cells a side, one about every sample
        x = (np.arange(fine) - 0.5 * (fine - 1)) * n / (fine * self.oversampling)
        share = np.mean(self.density(x, x[:, None]) >= 0.5 * self.peak)
        return float(n / self.oversampling * math.sqrt(share / (2.0 * math.pi * math.log(2.0))))

    @property
    def core(self) -> tuple[float, float]:
        """Arguments of `Detector.quadrature`: the width, pixel, and an exponent of wings that few PSFs exceed."""
        return self.sigma, 3.0

    @property
    def profile(self) -> Spline:
        """The PSF of unit width as the compiled loops need it."""
        pitch = 1.0 / (self.oversampling * self.sigma)
        return Spline(1.0 / pitch**2, self._spline, pitch)

    def reach(self, tolerance: float) -> float:
        """Distance from the middle beyond which the PSF is below `tolerance` times its peak, pixel.

        Between samples the spline does not exceed the largest of the 4 x 4 coefficients that make
        it.
        """
        if tolerance == 0.0:
            return math.inf
        c = np.abs(self._spline)
        four = np.lib.stride_tricks.sliding_window_view(c, (4, 4)).max(axis=(2, 3))
        j, i = np.nonzero(four >= tolerance * self.peak / self.oversampling**2)
        half = 0.5 * (len(four) - 1)  # a cell's middle is so far from the first cell's
        return float(
            np.hypot(np.abs(i - half) + 0.5, np.abs(j - half) + 0.5).max() / self.oversampling
        )

    def density(self, a: npt.ArrayLike, b: npt.ArrayLike) -> Floats:
        """The PSF at (a, b), pixel from its middle; per square pixel."""
        at = np.stack(np.broadcast_arrays(b, a)) * self.oversampling + 0.5 * (len(self._spline) - 1)
        values = ndimage.map_coordinates(self._spline, at.reshape(2, -1), prefilter=False)
        return np.asarray(self.oversampling**2 * values.reshape(at.shape[1:]))


PSF = GaussianPSF | MoffatPSF | SampledPSF


def _coefficients(values: Floats) -> Floats:
    """Of the cubic spline through the values: along either axis (c[i - 1] + 4 c[i] + c[i + 1]) / 6 = value, with zeros outside."""
    bands = np.array([np.full(len(values), 1.0 / 6.0), np.full(len(values), 4.0 / 6.0)])
    return np.asarray(linalg.solveh_banded(bands, linalg.solveh_banded(bands, values).T).T)

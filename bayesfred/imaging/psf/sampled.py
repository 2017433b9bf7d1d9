"""A PSF of any shape: the cubic spline through samples of it."""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from scipy import ndimage, special

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.imaging.kernels.compilation import inner
from bayesfred.imaging.kernels.contexts import LANES
from bayesfred.imaging.kernels.splines import (
    BITS,
    eight_values,
    run_length,
    spline_cell,
    spline_second_derivatives,
    spline_slopes,
)
from bayesfred.imaging.psf.spline_values import spline_coefficients
from bayesfred.io.serialize import serializable

MOST_SAMPLES = 1001  # a side
OUTSIDE = 1 << 40  # more than any cell's number
CLOSE = 2.0**-20  # what is this far before a cell is taken for in it: rounding must not part pixels
MARGIN = 4  # zeros around a spline's coefficients


@inner()
def new_spline_places(width):
    """Cells, what is passed of them along y and x, and values, see `SplineProfile.find_places`."""
    # The last pixels are made together with what lies behind them. It is zero at first: what memory
    # holds may be denormal numbers, with which arithmetic takes a hundred times as long.
    size = width + LANES
    return np.empty(size, np.int64), np.zeros(size), np.zeros(size), np.empty(size)


class SplineProfile(NamedTuple):
    """norm times a cubic spline, see `imaging/kernels/psf_dispatch` and `imaging/kernels/splines`.

    The spline is the sum of c[j, i] B(y - j) B(x - i), with B the cubic B-spline and (x, y) =
    scale (a, b) counted from the middle of c. The four outermost rows and columns of c are zero.
    """

    norm: float
    c: Floats
    phases: Floats  # the same coefficients as `eight_values` needs them
    columns: Ints  # where those of the first row are among them
    stride: int  # samples from pixel to pixel
    scale: float  # samples per width

    @staticmethod
    def slopes(psf: Any, a: Any, b: Any) -> Any:
        k = psf.scale
        i, x = spline_cell(psf.c.shape[1], k * a)
        j, y = spline_cell(psf.c.shape[0], k * b)
        p, p_x, p_y = spline_slopes(psf.c, j * psf.c.shape[1] + i, y, x)
        return p, -k * p_x, -k * p_y

    @staticmethod
    def second_derivatives(psf: Any, a: Any, b: Any) -> Any:
        k = psf.scale
        i, x = spline_cell(psf.c.shape[1], k * a)
        j, y = spline_cell(psf.c.shape[0], k * b)
        p_x, p_y, p_xx, p_xy, p_yy = spline_second_derivatives(psf.c, j * psf.c.shape[1] + i, y, x)
        return -k * p_x, -k * p_y, k * k * p_xx, k * k * p_xy, k * k * p_yy

    @staticmethod
    def new_places(psf: Any, width: Any) -> Any:
        return new_spline_places(width)

    @staticmethod
    def find_places(psf: Any, pixels: Any, work: Any, degrees: Any, places: Any) -> Any:
        # two loops: one would have more arrays than a compiler tells apart, and be no SIMD loop
        (t0, ramp, size), (at, y, x, p) = pixels, places
        a, b, top, width = work[2], work[3], len(degrees.ab), psf.columns.size
        c, columns, stride, scale = psf.phases, psf.columns, psf.stride, psf.scale
        pitch, far = -(-width // stride) * stride, 0.5 * (width - 1) - 1.5
        for n in range(size):
            t = t0 + ramp[n]
            z = b[top]
            for m in range(top):
                z = z * t + b[top - 1 - m]
            j, passed = spline_cell(psf.c.shape[0], scale * z + CLOSE)
            at[n], y[n] = j << BITS, passed - CLOSE
        for n in range(size):
            t = t0 + ramp[n]
            z = a[top]
            for m in range(top):
                z = z * t + a[top - 1 - m]
            i, passed = spline_cell(width, scale * z + CLOSE)
            x[n] = passed - CLOSE
            at[n] = at[n] + i if abs(scale * z) < far else stride * n - OUTSIDE
        n = 0
        while n < size:
            cell = max(at[n], 0)
            i, begin = cell & (1 << BITS) - 1, (cell >> BITS) * pitch
            first = begin + columns[i], begin + columns[i + 1]
            second = begin + columns[i + 2], begin + columns[i + 3]
            eight_values(c, ((*first, *second), pitch), (y, x), n, p)
            n += run_length(at, n, stride)

    @staticmethod
    def at_place(psf: Any, places: Any, n: Any) -> Any:
        return places[3][n]


def spline_profile(norm: float, c: Floats, scale: float, stride: int) -> Any:
    """The compiled half of a PSF, or of one for every source.

    Parameters
    ----------
    norm : float
        This and the others as in `SplineProfile`.
    c : ndarray, shape (n, n) or (s, n, n)
    scale : float
    stride : int

    Returns
    -------
    SplineProfile or FieldProfile
    """
    beside = min(LANES * stride, MOST_SAMPLES)  # zeros, so that a row ends with whole vectors
    n = c.shape[-1] + 2 * beside
    among = -(-n // stride)  # coefficients of a phase in a row
    columns = np.arange(n) % stride * among + np.arange(n) // stride
    size = c.shape[-2] * stride * among
    padded = np.zeros((*c.shape[:-2], size + LANES))
    phases = padded[..., :size].reshape(*c.shape[:-1], stride, among)
    for phase in range(stride):
        first = (phase - beside) % stride
        own = c[..., first::stride]
        begin = (first + beside) // stride
        phases[..., phase, begin : begin + own.shape[-1]] = own
    family = SplineProfile if c.ndim == 2 else FieldProfile
    return family(norm, c, padded, columns, stride, scale)


class FieldProfile(NamedTuple):
    """A spline for every source, see `imaging/kernels/psf_dispatch`."""

    norm: float
    c: Floats  # (s, n, n)
    phases: Floats  # (s, coefficients)
    columns: Ints
    stride: int
    scale: float

    @staticmethod
    def new_places(psf: Any, width: Any) -> Any:
        return new_spline_places(width)

    @staticmethod
    def of_source(psf: Any, s: Any) -> Any:
        norm, c, phases, columns, stride, scale = psf
        return SplineProfile(norm, c[s], phases[s], columns, stride, scale)


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
    >>> round(psf.sigma, 2), round(float(psf.density(1.1, 0.3)) * 8 * np.pi, 4)
    (2.0, 0.85)
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
            total, scale = float(values.sum()), float(spline_coefficients(values).sum())
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
        """Measure the PSF on one isolated source near the axis, where distortion vanishes.

        Whittaker and Shannon's interpolation in its finite form: an image that is band-limited and
        dark at its window's border is the trigonometric polynomial through its pixels. Samples are
        exact for a Gaussian of sigma >= 2 pixels to 1e-7 of the peak, and the noise of the counts
        goes into them as it is. Of a frame that integrates over pixels the PSF is measured with the
        pixel in it: fit with impulse pixels, or take the pixel out of the frame first with
        `correct_sampling`.

        Parameters
        ----------
        counts : array_like, shape (ny, nx), counts
        position : (float, float), pixel
            Where the source is imaged, u and v from the frame's middle.
        half_width : int, pixel
            Of the window around it, which should hold all of the image and nothing else.
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
            If the window is not within the frame, or holds no source.

        References
        ----------
        Sun & Zhou, Section 2.3 and Fig. 5.

        Examples
        --------
        >>> import bayesfred as bf
        >>> model = bf.ForwardModel(
        ...     bf.Detector((65, 65)), bf.SourceCatalog([0.3], [-0.2], [1e4]), bf.GaussianPSF(2.0),
        ...     bf.PolynomialDistortion.mirrored())
        >>> frame = model.expected_counts([0.0] * 12, 7.0)
        >>> psf = bf.SampledPSF.measured(frame, (0.3, -0.2), 14, background=7.0)
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
        most = math.floor(
            (half_width - 0.5) * oversampling
        )  # so that no sample lies outside of the window
        matrices, window = [], []
        for centre, size in zip(position, frame.shape[::-1], strict=True):
            middle = centre + 0.5 * (size - 1)
            first = round(middle) - half_width if math.isfinite(middle) else -1
            if not 0 <= first <= size - 2 * half_width - 1:
                raise InputError(
                    f"psf: position: got {tuple(position)} with half_width {half_width}, expected "
                    "the window within the frame of "
                    f"{frame.shape[1]} x {frame.shape[0]} pixels from its middle"
                )
            n = 2 * half_width + 1
            samples = middle + np.arange(-most, most + 1) / oversampling
            matrices.append(
                special.diric(2.0 * np.pi / n * (samples[:, None] - np.arange(first, first + n)), n)
            )
            window.append(slice(first, first + n))
        image = frame[window[1], window[0]] - background
        return cls(matrices[1] @ image @ matrices[0].T, oversampling)

    @cached_property
    def _spline(self) -> Floats:
        """The spline's coefficients in units of their sum, with zeros around them."""
        c = spline_coefficients(self.values)
        return np.pad(c / c.sum(), MARGIN)

    @cached_property
    def peak(self) -> float:
        """Largest sample, per square pixel."""
        return float(
            self.values.max() / spline_coefficients(self.values).sum() * self.oversampling**2
        )

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
        """See `PSF`; few PSFs have wings that exceed these."""
        return self.sigma, 3.0

    @property
    def profile(self) -> Any:
        """The PSF of unit width as the compiled loops need it."""
        return self.binned_profile(1)

    def binned_profile(self, binning: int) -> Any:
        """The same where a recorded pixel is this many pixels wide."""
        scale, stride = self.oversampling * self.sigma, round(self.oversampling * binning)
        return spline_profile(scale**2, self._spline, scale, stride)

    def support_radius(self, tolerance: float) -> float:
        """Distance from the middle beyond which p is below `tolerance` times its peak, pixel.

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

"""The image sensor: which points of the image plane a recorded pixel consists of.

Two pixel responses. `impulse` samples the image at the centre of every fine pixel, which is what
the paper assumes of a frame that it has corrected; `box` integrates over the pixel, which is what a
sensor does. Binning B adds B x B fine pixels to one recorded pixel. Either way a recorded pixel is
a weighted sum over a small grid of points, `Detector.quadrature` along each axis, so `forward`
knows no cases. `sampling_matrix` and `correct_sampling` are the paper's way from a recorded frame
back to an impulse-sampled one; they correlate the noise, so inference on counts uses `box` instead.
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_toeplitz, toeplitz
from scipy.special import sici

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io.arrays import frame_given
from bayesfred.io.serialize import serializable

PIXELS = ("impulse", "box")

# Bound on the box rule's error along one axis. Up to pixels of 12 sigma the two axes together stay
# below 6e-7 of the peak, even where the distortion narrows an image 1.3 times: see `_box_order`.
BOX_TOLERANCE = 2e-8

# Most points along a pixel's side: the sum over their square would take too long.
MOST_POINTS = 1000


@serializable("detector")
@dataclass(frozen=True)
class Detector:
    """Geometry and pixel response of a frame.

    Attributes
    ----------
    shape : tuple of int, (ny, nx)
        Recorded pixels along v and u.
    binning : int
        Fine pixels along each side of a recorded pixel.
    pixel : {"impulse", "box"}
        Sum of samples at the fine pixels' centres, or integral over the recorded pixel.

    Raises
    ------
    InputError
        If `shape` is not two integers >= 1, `binning` is not an integer from 1 to `MOST_POINTS`, or
        `pixel` is not one of the two.

    References
    ----------
    Sun & Zhou, section 3.1 and appendix A (sampling effect); section 4.3 (binning).

    Examples
    --------
    >>> Detector(shape=(127, 127), binning=25).fine_shape
    (3175, 3175)
    """

    shape: tuple[int, int]
    binning: int = 1
    pixel: str = "impulse"

    def __post_init__(self) -> None:
        try:
            ny, nx = (operator.index(side) for side in self.shape)
        except (TypeError, ValueError):
            raise InputError(f"shape: got {self.shape!r}, expected two integers (ny, nx)") from None
        if min(ny, nx) < 1:
            raise InputError(f"shape: got {(ny, nx)}, expected (ny, nx) of at least 1 pixel each")
        if not isinstance(self.binning, int | np.integer) or not 1 <= self.binning <= MOST_POINTS:
            raise InputError(
                f"binning: got {self.binning!r}, expected an integer of 1 to {MOST_POINTS}"
            )
        if self.pixel not in PIXELS:
            raise InputError(
                f"pixel: got {self.pixel!r}, expected one of {', '.join(map(repr, PIXELS))}"
            )
        object.__setattr__(self, "shape", (ny, nx))
        object.__setattr__(self, "binning", int(self.binning))

    @property
    def fine_shape(self) -> tuple[int, int]:
        """Fine pixels of the frame, (ny * binning, nx * binning)."""
        return self.shape[0] * self.binning, self.shape[1] * self.binning

    def pixel_centres(self) -> tuple[Floats, Floats]:
        """Centres of the recorded pixels, u of every column and v of every row.

        Returns
        -------
        u : ndarray, shape (nx,), fine pixel
            From the middle of the frame.
        v : ndarray, shape (ny,), fine pixel

        Examples
        --------
        >>> u, v = Detector(shape=(2, 3), binning=4).pixel_centres()
        >>> u.tolist(), v.tolist()
        ([-4.0, 0.0, 4.0], [-2.0, 2.0])
        """
        ny, nx = self.shape
        return _centred(nx) * self.binning, _centred(ny) * self.binning

    def quadrature(self, sigma: float, beta: float = math.inf) -> tuple[Floats, Floats]:
        """Points and weights along one axis whose sum gives a recorded pixel.

        The same rule serves both axes.

        Parameters
        ----------
        sigma : float, fine pixel
            Width (Gaussian standard deviation) of the narrowest structure that the PSF has; `box`
            chooses the number of points by it.
        beta : float
            Exponent of a Moffat function, if it is one whose peak is curved like this Gaussian's.

        Returns
        -------
        offsets : ndarray, shape (n,), fine pixel
            From the pixel's centre.
        weights : ndarray, shape (n,), fine pixel
            They sum to `binning`.

        Raises
        ------
        InputError
            If `sigma` is not a finite number > 0, or so small that a pixel would take more than
            `MOST_POINTS` points a side.

        Examples
        --------
        >>> offsets, weights = Detector(shape=(8, 8), binning=2).quadrature(sigma=3.0)
        >>> offsets.tolist(), weights.tolist()
        ([-0.5, 0.5], [1.0, 1.0])
        """
        if not (math.isfinite(sigma) and sigma > 0.0):
            raise InputError(f"sigma: got {sigma!r}, expected a finite number of pixels > 0")
        if self.pixel == "impulse":
            return _centred(self.binning), np.ones(self.binning)
        nodes, weights = np.polynomial.legendre.leggauss(_box_order(self.binning / sigma, beta))
        half = self.binning / 2.0
        return np.asarray(nodes * half, dtype=np.float64), np.asarray(
            weights * half, dtype=np.float64
        )


def _centred(n: int) -> Floats:
    """0 ... n - 1 counted from their middle."""
    return np.asarray(np.arange(n) - (n - 1) / 2.0, dtype=np.float64)


def _box_order(width: float, beta: float) -> int:
    """Smallest Gauss-Legendre order q that integrates the PSF over a pixel to BOX_TOLERANCE.

    The PSF is a Gaussian or a Moffat function, the pixel `width` sigma wide.

    Over an interval h the rule's error is h^(2q+1) (q!)^4 / ((2q+1) ((2q)!)^3) |F^(2q)| at some
    point of it. The even derivatives of F = exp(-x^2 / 2 s^2) are largest at x = 0 (its Fourier
    transform is positive), where they are (2q-1)!! / s^(2q) with (2q-1)!! = (2q)! / (2^q q!). So,
    per unit of h, it is at most

        e_q = (h/s)^(2q) (q!)^3 / ((2q+1) ((2q)!)^2 2^q),   e_0 = 1,
        e_q / e_(q-1) = (h/s)^2 q / (8 (4q^2 - 1)).

    Those of a Moffat, F = (1 + x^2 / 2 beta s^2)^-beta, are largest there for the same reason:
    (2q)! / q! times beta (beta + 1) ... (beta + q - 1) / (2 beta s^2)^q. So every step of e_q has a
    factor 1 + (q - 1) / beta.

    Distortion that narrows an image by a factor c multiplies e_q by c^(2q).
    """
    order, bound = 0, 1.0
    while order == 0 or bound > BOX_TOLERANCE:
        order += 1
        if order > MOST_POINTS:
            raise InputError(
                f"psf: sigma: got pixels of {width:.3g} sigma with pixel = 'box', expected few "
                "enough to integrate over with "
                f"{MOST_POINTS} points a side: widen the PSF or bin less"
            )
        bound *= width * width * order * (1.0 + (order - 1) / beta) / (8.0 * (4 * order**2 - 1))
    return order


def sampling_matrix(n: int) -> Floats:
    """Build the paper's matrix R, which turns impulse samples along one axis into pixel integrals.

    A band-limited image is the sum over m of I_m sinc(u - m) (Whittaker-Shannon; sinc t is sin(pi
    t) / pi t). Its integral over pixel i is the sum of R_im I_m with

        R_im = int_{i-1/2}^{i+1/2} sinc(u - m) du = [Si(pi (k + 1/2)) - Si(pi (k - 1/2))] / pi,   k
        = i - m,

    Si the sine integral. R depends on |i - m| alone: a symmetric Toeplitz matrix. On a frame it
    acts along both axes, R I R. The sum over m runs over the frame only, so the image has to vanish
    at its border.

    Parameters
    ----------
    n : int
        Pixels along the axis.

    Returns
    -------
    matrix : ndarray, shape (n, n), dimensionless

    Raises
    ------
    InputError
        If `n` is not an integer >= 1.

    References
    ----------
    Sun & Zhou, appendix A.

    Examples
    --------
    >>> sampling_matrix(3).round(4).tolist()
    [[0.8727, 0.0756, -0.0167], [0.0756, 0.8727, 0.0756], [-0.0167, 0.0756, 0.8727]]
    """
    if not isinstance(n, int | np.integer) or n < 1:
        raise InputError(f"n: got {n!r}, expected an integer of at least 1")
    return np.asarray(toeplitz(_sampling_column(int(n))), dtype=np.float64)


def correct_sampling(frame: ArrayLike) -> Floats:
    """Turn a frame of pixel integrals into impulse samples at the pixels' centres: R^-1 I R^-1.

    R is `sampling_matrix` of each axis' length; a Toeplitz solver stands for the inverse. The
    correction correlates the noise of neighbouring pixels: fit raw counts with
    `Detector(pixel="box")` instead.

    Parameters
    ----------
    frame : array_like, shape (ny, nx), counts
        Recorded frame; it should vanish at its border.

    Returns
    -------
    corrected : ndarray, shape (ny, nx), counts per pixel area

    Raises
    ------
    InputError
        If the frame is not two-dimensional, is empty or has values that are not finite.

    References
    ----------
    Sun & Zhou, appendix A and Fig. 4.
    """
    values, _ = frame_given(frame)  # not finite where it is masked
    if values.ndim != 2 or values.size == 0:
        raise InputError(f"frame: got shape {values.shape}, expected two dimensions (ny, nx)")
    if not np.isfinite(values).all():
        bad = values.size - int(np.isfinite(values).sum())
        raise InputError(
            f"frame: got {bad} pixels that are not finite, expected none: fill them first"
        )
    ny, nx = values.shape
    rows_solved = solve_toeplitz(_sampling_column(ny), values)
    return np.ascontiguousarray(
        solve_toeplitz(_sampling_column(nx), rows_solved.T).T, dtype=np.float64
    )


def _sampling_column(n: int) -> Floats:
    """First column of R, r_0 ... r_(n-1)."""
    edges, _ = sici(np.pi * (np.arange(n + 1) - 0.5))
    return np.asarray(np.diff(edges) / np.pi, dtype=np.float64)

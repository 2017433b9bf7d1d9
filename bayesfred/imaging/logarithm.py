"""A distortion that is not polynomial, the paper's logarithm.

Frames are simulated with it, and polynomials fitted to them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable


@serializable("distortion.logarithm")
@dataclass(frozen=True)
class LogDistortion:
    """f = x log(1 + c (u^2 + v^2)), g = y log(1 + c (u^2 + v^2)): barrel-shaped.

    There are no coefficients to fit: the methods' argument theta, see `Distortion`, is empty.

    Attributes
    ----------
    c : float, pixel^-2
        Strength, >= 0.

    Raises
    ------
    InputError
        If `c` is negative or not finite.

    References
    ----------
    Sun & Zhou, Fig. 2c, where c = 1e-5.

    Examples
    --------
    >>> u, v = LogDistortion(1e-5).image_position([], x=200.0, y=-200.0)
    >>> print(u.round(2), v.round(2))
    136.58 -136.58
    """

    c: float
    n_terms: ClassVar[int] = 0
    names: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        if not (np.isfinite(self.c) and self.c >= 0.0):
            raise InputError(f"c: got {self.c}, expected a finite number >= 0")

    def displacement(
        self, theta: ArrayLike, u: ArrayLike, v: ArrayLike, x: ArrayLike, y: ArrayLike
    ) -> tuple[Floats, Floats]:
        """Evaluate f and g, pixel; see `PolynomialDistortion.displacement`."""
        u, v, x, y = (np.asarray(value, dtype=np.float64) for value in (u, v, x, y))
        logarithm = np.log1p(self.c * (u**2 + v**2))
        return x * logarithm, y * logarithm

    def determinant(
        self, theta: ArrayLike, u: ArrayLike, v: ArrayLike, x: ArrayLike, y: ArrayLike
    ) -> Floats:
        """Jacobian determinant D = (1 + f_u)(1 + g_v) - f_v g_u; f_u g_v and f_v g_u cancel."""
        u, v, x, y = (np.asarray(value, dtype=np.float64) for value in (u, v, x, y))
        return np.asarray(1.0 + 2.0 * self.c * (x * u + y * v) / (1.0 + self.c * (u**2 + v**2)))

    def image_position(self, theta: ArrayLike, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """Where the image of an object point stands, pixel.

        It is on the same radius, at the distance rho = r (1 - log(1 + c rho^2)) from the axis.
        """
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        r = np.hypot(x, y)
        rho = optimize.newton(
            lambda rho: rho - r + r * np.log1p(self.c * rho**2),
            r,
            lambda rho: 1.0 + 2.0 * self.c * r * rho / (1.0 + self.c * rho**2),
            tol=1e-12,
        )
        ratio = np.divide(rho, r, out=np.ones_like(r), where=r > 0.0)
        return x * ratio, y * ratio

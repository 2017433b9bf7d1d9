"""The modes of a source's shift.

Along the shift let the counts tell of it with the information a about the place m, in standard
deviations s = 1/sqrt(a), and let Student's prior of `fluxes.py` hold it at zero:

    -log p(x) = a/2 (x - m)^2 + (nu/2 + 1) log(1 + x^2/c),    c = nu tau^2

Its slope a (x - m) + (nu + 2) x / (c + x^2) has one root or three. The prior is nowhere more
concave than (nu + 2) / 8 c, at x^2 = 3 c: where a is more than that there is one mode. Otherwise a
source some s off has one near zero, as if the counts were wrong, and one near m, as if the
catalogue were. Both right sides of

    x = m - (nu + 2) x / a (c + x^2)    for x^2 > c,        x = m / (1 + (nu + 2) / a (c + x^2))

rise with x, so that the iteration of the first falls from m to the largest root, and that of the
second rises from 0 to the smallest. At a mode d the slope tells m = d + (nu + 2) d / a (c + d^2).
"""

import math

from bayesfred.imaging.kernels.compilation import inner
from bayesfred.model.kernels.clusters import DOF, SHARE

FARTHEST = 2.0  # widths of the PSF within which the counts' slope says where the other mode is


@inner()
def _height(x, m, known, c):
    """Minus the log-density of a mode, and half the logarithm of its determinant."""
    held = SHARE * (DOF + 2.0) / (known * (c + x * x))
    return 0.5 * known * (x - m) ** 2 + (0.5 * DOF + 1.0) * math.log1p(x * x / c) + math.log1p(held)


@inner()
def other_mode(shift, known, scatter, sigma):
    """By how much the other mode is higher, and where it is in units of this one.

    `shift` is the distance from zero of a mode that was found, `known` the information a. The gain
    is -inf where there is no other within reach of a PSF of width sigma.
    """
    c = DOF * scatter**2
    if not (shift > 0.0 and 0.0 < known < (DOF + 2.0) / (8.0 * c)):
        return -math.inf, 1.0
    m = shift * (1.0 + (DOF + 2.0) / (known * (c + shift * shift)))
    far, near = m, 0.0
    for _ in range(60):
        if far * far > c:
            far = m - (DOF + 2.0) * far / (known * (c + far * far))
        near = m / (1.0 + (DOF + 2.0) / (known * (c + near * near)))
    if not (far * far > c and near < 0.9 * far):
        return -math.inf, 1.0
    other = far if abs(shift - near) < abs(shift - far) else near
    if other > FARTHEST * sigma:
        return -math.inf, 1.0
    gain = _height(shift, m, known, c) - _height(other, m, known, c)
    return gain, other / shift

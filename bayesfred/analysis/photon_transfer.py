"""Gain, read noise and pedestal from the noise of a frame, or of two frames of one scene.

A pixel that stores m adu on average has the variance

    V = (m - P) / g + R^2 / g^2 = alpha + beta m,     beta = 1 / g,

for a gain g (e-/adu), a pedestal P (adu) and a read noise R (e-). The line has two numbers: the
gain, and the level Z = P - R^2 / g at which the variance vanishes.

The variance of one frame comes from differences of neighbours: of the four pixels a b / c d of a
block, e = (a - b - c + d) / 2 has the variance of a pixel and is free of any gradient. Where light
is curved, E e^2 = V + delta^2, and the corners of the 4 x 4 pixels around, three times as far
apart, have 81 delta^2. So (81 e^2 - e_corners^2) / 80 is free of smooth structure. Blocks that
stand out of their surroundings are left out. With two frames half their squared difference is the
variance, whatever the scene.

The light m at a block or pixel is not known without noise, and what is known of it has the noise of
e^2 in it. The light z of the neighbours has neither. So the line is found with z as an instrument:
sums weighted with 1 / V(z)^2 of (e^2 - alpha - beta m) and of (e^2 - alpha - beta m) z are zero.

Two frames tell P and R apart by the third moment, which is that of photons alone, (m - P) / g^2:
for h, a pixel's mean of the two frames less its neighbours', and y = (f1 - f2)^2 / 2,

    E[y h] = (m - P) / 2 g^2 + E[(alpha + beta m) h],

where products of one frame's light with the other's h give the last term without noise of their
own. One frame only bounds R, for P is not above the darkest light.

Errors come from leaving out each of 64 parts of the frame in turn.

References
----------
J. R. Janesick (2007), Photon Transfer, SPIE Press.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.io.arrays import stored_values
from bayesfred.io.saturation import plateau

__all__ = ["PhotonTransfer", "photon_transfer"]

PARTS = 8  # along each side of the frame
ROUNDS = 6
STANDS_OUT = 4.0  # standard deviations
CLIP = 36.0  # times the variance: cosmic rays, hot pixels
LARGEST = 2**22  # pixels in which every block is used
SURE = 4.0  # standard deviations of the slope
DARKEST = 0.01  # quantile of the light


@dataclass(frozen=True)
class PhotonTransfer:
    """What the noise of frames says of a detector, with standard deviations.

    Attributes
    ----------
    gain, gain_sd : float, e-/adu
    zero_level, zero_level_sd : float, adu
        Where the variance vanishes. With this for a pedestal, and no read noise, counts have the
        variance that Poisson's distribution gives them.
    read_noise, read_noise_sd : float, e-
    pedestal, pedestal_sd : float, adu
        Of one frame these are of a read noise that may be anything between none and the most that
        the darkest light admits.
    frames : int
        1 or 2.
    message : str
        One line.
    """

    gain: float
    gain_sd: float
    zero_level: float
    zero_level_sd: float
    read_noise: float
    read_noise_sd: float
    pedestal: float
    pedestal_sd: float
    frames: int
    message: str


@dataclass(frozen=True, eq=False)
class _Samples:
    """Numbers of every block or pixel; nan where one is not to be used."""

    variance: Floats
    light: Floats
    around: Floats
    standing_out: Floats  # over the standard deviation of a pixel
    third: tuple[Floats, Floats, Floats] | None = None  # h, f1 h2 + f2 h1, h2 + h1


def photon_transfer(frame: Any, second: Any = None) -> PhotonTransfer:
    """Measure gain, read noise and pedestal by the noise of one frame or of two.

    Parameters
    ----------
    frame : array_like, MaskedArray, Quantity, NDData or CCDData, shape (ny, nx), adu
        As stored, with the noise of neighbouring pixels independent: neither resampled nor
        smoothed. Masked pixels and a plateau at the maximum are left out.
    second : array_like, shape (ny, nx), adu, optional
        Another frame of the same scene and exposure.

    Returns
    -------
    PhotonTransfer

    Raises
    ------
    InputError
        If a frame is no image, the two differ in shape, or the light varies too little to tell how
        the noise grows with it.

    Examples
    --------
    >>> light = 400.0 * np.linspace(0.1, 1.0, 400) * np.ones((400, 1))  # electrons
    >>> rng = np.random.default_rng(1)
    >>> one, two = (rng.poisson(light) + rng.normal(0.0, 8.0, light.shape) for _ in range(2))
    >>> found = photon_transfer(one / 2.5 + 100.0, two / 2.5 + 100.0)
    >>> print(found.message)
    gain 2.466 +- 0.02 e-/adu; read noise 9.33 +- 1 e-; pedestal 111.5 +- 8 adu
    """
    frames = [_image(each) for each in (frame, second) if each is not None]
    if len({each.shape for each in frames}) > 1:
        raise InputError(
            f"second: got shape {frames[1].shape}, expected the first frame's {frames[0].shape}"
        )
    samples = _one(frames[0]) if second is None else _two(*frames)
    sums = _fit(samples)
    beta, alpha = _line(sums.sum(axis=0))
    parts = _left_out(sums)
    slopes = np.array([_line(part)[0] for part in parts])
    if not beta > SURE * _spread(slopes):
        low, high = np.nanquantile(samples.around, [DARKEST, 1.0 - DARKEST])
        raise InputError(
            f"frame: got light between {low:.4g} and {high:.4g} adu, in which the noise does not "
            "measurably grow, expected a wider range: give a frame, or two, with more light"
        )
    zero = -alpha / beta
    zero_sd = _spread(np.array([-a / b for b, a in map(_line, parts)]))
    gain, gain_sd = 1.0 / beta, _spread(1.0 / slopes)
    if second is None:
        darkest = float(np.nanquantile(samples.around, DARKEST))
        most = float(np.sqrt(max(darkest - zero, 0.0) * gain))
        noise, noise_sd = 0.5 * most, most / 12.0**0.5
        pedestal = zero + most**2 / gain / 3.0
        pedestal_sd = float(np.hypot(most**2 / gain * (4.0 / 45.0) ** 0.5, zero_sd))
        rest = (
            f"one frame does not tell read noise from pedestal: at most {most:.3g} e-, with the "
            f"pedestal at {darkest:.4g} adu; without read noise the pedestal is {zero:.4g}"
        )
    else:
        pedestal, square = _pedestal(sums.sum(axis=0))
        many = np.array([_pedestal(part) for part in parts])
        pedestal_sd, square_sd = _spread(many[:, 0]), _spread(many[:, 1])
        noise = float(np.sqrt(max(square, 0.0)))
        noise_sd = float(square_sd / (2.0 * max(noise, square_sd**0.5)))
        rest = (
            f"read noise {noise:.3g} +- {noise_sd:.1g} e-; pedestal {pedestal:.4g} +- "
            f"{pedestal_sd:.1g} adu"
        )
    message = f"gain {gain:.4g} +- {gain_sd:.1g} e-/adu; {rest}"
    return PhotonTransfer(
        gain, gain_sd, zero, zero_sd, noise, noise_sd, pedestal, pedestal_sd, len(frames), message
    )


def _image(frame: Any) -> Floats:
    """A frame's numbers, nan where they are masked, not finite or look saturated."""
    values = stored_values(frame)
    if values.ndim != 2 or min(values.shape) < 4 * PARTS:
        raise InputError(
            f"frame: got shape {values.shape}, expected (ny, nx) of at least {4 * PARTS} pixels"
        )
    values[~np.isfinite(values)] = np.nan
    level = plateau(values[np.isfinite(values)])
    if level is not None:
        values[values >= level] = np.nan
    return values


def _one(f: Floats) -> _Samples:
    """Blocks of 2 x 2 pixels, with the 12 around them."""
    ny, nx = f.shape
    step = 1 if f.size <= LARGEST else 2
    at = {
        (j, i): f[j : ny - 3 + j : step, i : nx - 3 + i : step] for j in range(4) for i in range(4)
    }
    core = [at[j, i] for j in (1, 2) for i in (1, 2)]
    square = (0.5 * (core[0] - core[1] - core[2] + core[3])) ** 2
    far = 0.5 * (at[0, 0] - at[0, 3] - at[3, 0] + at[3, 3])
    light = np.asarray(sum(core)) / 4.0
    around = (np.asarray(sum(at.values())) - 4.0 * light) / 12.0
    out = np.maximum(np.abs(far), np.abs(light - around) / (1.0 / 4.0 + 1.0 / 12.0) ** 0.5)
    return _Samples((81.0 * square - far**2) / 80.0, light, around, out)


def _two(f1: Floats, f2: Floats) -> _Samples:
    """Pixels of two frames, with the 8 around them."""
    f2 = f2 - np.nanmedian(f2 - f1)
    ring = np.ones((3, 3)) / 8.0
    ring[1, 1] = 0.0
    z1, z2 = (ndimage.convolve(f, ring, mode="constant", cval=np.nan) for f in (f1, f2))
    h1, h2 = f1 - z1, f2 - z2
    moved = np.abs(z1 - z2) * 2.0  # sd of a pixel's: sqrt(2 / 8) = 1 / 2
    third = (0.5 * (h1 + h2), f1 * h2 + f2 * h1, h1 + h2)
    return _Samples(0.5 * (f1 - f2) ** 2, 0.5 * (f1 + f2), 0.5 * (z1 + z2), moved, third)


def _fit(samples: _Samples) -> Floats:
    """Weighted sums of every part of the frame, shape (64, k), once the weights are settled."""
    y, x, z = samples.variance, samples.light, samples.around
    ny, nx = y.shape
    part = (np.arange(ny) * PARTS // ny * PARTS)[:, None] + np.arange(nx) * PARTS // nx
    finite = np.isfinite(y + x + z + samples.standing_out)
    if not finite.any():
        raise InputError("frame: got no pixels to use, expected some that are not masked")
    level = float(np.median(y[finite])) / 0.45  # of a chi-square with one degree
    level = level if level > 0.0 else float(np.mean(y[finite]))  # at counts of zero and one
    if not level > 0.0:
        raise InputError("frame: got pixels that are all alike, expected noise: give a raw frame")
    beta, alpha = 0.0, level
    for _ in range(ROUNDS):
        v = np.maximum(alpha + beta * z, 0.05 * level)
        grain = max(beta, 0.0) ** 2  # of one electron
        out = ~finite | (samples.standing_out**2 > STANDS_OUT**2 * (v + grain))
        used = ~_wider(out) & (y < CLIP * (v + grain))
        sums = _sums(samples, used, v, part)
        beta, alpha = _line(sums.sum(axis=0))
    return sums


def _wider(out: Flags) -> Flags:
    return np.asarray(ndimage.binary_dilation(out, np.ones((3, 3), bool)))


def _sums(samples: _Samples, used: Flags, v: Floats, part: Any) -> Floats:
    """Sums over the parts of the frame, about the frame's mean light."""
    y, x, z = (each[used] for each in (samples.variance, samples.light, samples.around))
    w, middle = 1.0 / v[used] ** 2, float(np.mean(z))
    w /= w.mean()
    x, z = x - middle, z - middle
    terms = [w, w * y, w * x, w * z, w * y * z, w * x * z, w * middle]
    if samples.third is not None:
        h, cross, total = (each[used] for each in samples.third)
        terms += [w * y * h, w * h, 0.5 * w * (cross - middle * total)]
    return np.stack([np.bincount(part[used], t, PARTS**2) for t in terms], axis=1)


def _line(sums: Floats) -> tuple[float, float]:
    """Slope and intercept of the variance against the light."""
    n, y, x, z, yz, xz, middle = sums[:7]
    slope = float((yz - y * z / n) / (xz - x * z / n))
    return slope, float(y / n - slope * (x + middle) / n)


def _pedestal(sums: Floats) -> tuple[float, float]:
    """Pedestal, adu, and square of the read noise, e-^2."""
    beta, alpha = _line(sums)
    n, x, middle = sums[0], sums[2], sums[6]
    yh, h, mh = sums[7:]
    third = (yh - (alpha + beta * middle / n) * h - beta * mh) / n
    pedestal = float((x + middle) / n - 2.0 * third / beta**2)
    return pedestal, (alpha + beta * pedestal) / beta**2


def _left_out(sums: Floats) -> list[Floats]:
    """The sums without each part that has any."""
    return [sums.sum(axis=0) - part for part in sums if part[0] > 0.0]


def _spread(values: Floats) -> float:
    """The jackknife's standard deviation."""
    n = len(values)
    return float(np.sqrt((n - 1) / n * np.sum((values - values.mean()) ** 2)))

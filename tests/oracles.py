"""Slow images written from the formulas alone: every pixel, every source, one term at a time, no
truncation.

Nothing here knows the package: the tests compare the package with this. Terms are (i, j, m, n), the
powers of x, y, u, v; a catalogue is three sequences x, y, flux; coordinates are fine pixels from
the frame's middle.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Numbers = Sequence[float] | FloatArray
Terms = Sequence[Sequence[int]]
Sources = tuple[Numbers, Numbers, Numbers]


def polynomial(
    terms: Terms, theta: Numbers, u: FloatArray, v: FloatArray, x: float, y: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The value of f (or g) and its derivatives along u and v."""
    value, along_u, along_v = (np.zeros(np.broadcast(u, v).shape) for _ in range(3))
    for coefficient, (i, j, m, n) in zip(theta, terms, strict=True):
        lever = coefficient * x**i * y**j
        value += lever * u**m * v**n
        if m > 0:
            along_u += lever * m * u ** (m - 1) * v**n
        if n > 0:
            along_v += lever * n * u**m * v ** (n - 1)
    return value, along_u, along_v


def dense_image(
    f_terms: Terms,
    g_terms: Terms,
    theta: Numbers,
    sources: Sources,
    sigma: float,
    nodes: tuple[FloatArray, FloatArray],
    *,
    conserve_flux: bool,
) -> FloatArray:
    """The image at every pair of nodes, shape (v.size, u.size), counts per square fine pixel."""
    u, v = np.meshgrid(*nodes)
    image = np.zeros(u.shape)
    for x, y, flux in zip(*sources, strict=True):
        f, f_u, f_v = polynomial(f_terms, theta[: len(f_terms)], u, v, x, y)
        g, g_u, g_v = polynomial(g_terms, theta[len(f_terms) :], u, v, x, y)
        a, b = u - x + f, v - y + g
        kernel = np.exp(-(a**2 + b**2) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
        if conserve_flux:
            kernel *= np.abs((1 + f_u) * (1 + g_v) - f_v * g_u)
        image += flux * kernel
    return image


def middle_out(n: int) -> FloatArray:
    """The n integers' distances from their middle."""
    return np.asarray([k - (n - 1) / 2 for k in range(n)])


def impulse_nodes(shape: tuple[int, int], binning: int = 1) -> tuple[FloatArray, FloatArray]:
    """u and v of every fine pixel's centre."""
    return middle_out(shape[1] * binning), middle_out(shape[0] * binning)


def box_nodes(
    shape: tuple[int, int], binning: int = 1, order: int = 7
) -> tuple[FloatArray, FloatArray]:
    """u and v of `order` Gauss-Legendre nodes in every fine pixel."""
    offsets = np.polynomial.legendre.leggauss(order)[0] / 2
    u, v = impulse_nodes(shape, binning)
    return (u[:, None] + offsets).ravel(), (v[:, None] + offsets).ravel()


def bin_fine(image: FloatArray, binning: int) -> FloatArray:
    """Sums over binning x binning blocks."""
    ny, nx = image.shape[0] // binning, image.shape[1] // binning
    return np.asarray(image.reshape(ny, binning, nx, binning).sum(axis=(1, 3)))


def impulse_counts(
    f_terms: Terms,
    g_terms: Terms,
    theta: Numbers,
    sources: Sources,
    sigma: float,
    shape: tuple[int, int],
    binning: int = 1,
    *,
    conserve_flux: bool = True,
) -> FloatArray:
    """Sums of the samples at the fine pixels' centres, shape `shape`, counts per recorded pixel."""
    nodes = impulse_nodes(shape, binning)
    return bin_fine(
        dense_image(f_terms, g_terms, theta, sources, sigma, nodes, conserve_flux=conserve_flux),
        binning,
    )


def box_counts(
    f_terms: Terms,
    g_terms: Terms,
    theta: Numbers,
    sources: Sources,
    sigma: float,
    shape: tuple[int, int],
    binning: int = 1,
    *,
    conserve_flux: bool = True,
    order: int = 7,
) -> FloatArray:
    """Integrals over the recorded pixels by order x order Gauss-Legendre nodes in every fine
    pixel."""
    nodes = box_nodes(shape, binning, order)
    image = dense_image(f_terms, g_terms, theta, sources, sigma, nodes, conserve_flux=conserve_flux)
    weights = np.polynomial.legendre.leggauss(order)[1] / 2
    image *= np.tile(weights, shape[1] * binning) * np.tile(weights, shape[0] * binning)[:, None]
    return bin_fine(image, binning * order)


def next_term(light: FloatArray, weight: FloatArray, curve: FloatArray, shape: float) -> float:
    """The term after Laplace's of the integral over logarithms of fluxes, by dense tensors.

    `light`, shape (s, pixels), is that of every source, `weight` and `curve` are -d2/dmu2 and 1/2
    d3/dmu3 of the log-density of the counts; the fourth is that of Poisson counts.
    """
    n = len(light)
    ratio = np.divide(curve, weight, np.zeros_like(weight), where=weight > 0)
    alone = [_expansion(light[[s]], weight, ratio, shape) for s in range(n)]
    total = sum(alone)
    for s in range(n):
        for t in range(s):
            both = _expansion(light[[s, t]], weight, ratio, shape)
            total += both - alone[s] - alone[t]
    return total


def _expansion(light: FloatArray, weight: FloatArray, ratio: FloatArray, shape: float) -> float:
    one, x = np.eye(len(light)), light * ratio
    three = np.einsum("ij,jk->ijk", one, one)
    four = np.einsum("ijk,kl->ijkl", three, one)
    h = np.einsum("p,ip,jp->ij", weight, light, light) + shape * one
    g3 = 2 * np.einsum("p,ip,jp,kp->ijk", weight, light, light, x) + 2 * shape * three
    g4 = np.einsum("p,ip,jp,kp,lp->ijkl", weight, light, light, x, x) + shape * four
    # d/dlog F = F d/dF, and the first derivatives vanish at the maximum
    f3 = g3 - sum(np.einsum(f"{a}->ijk", one, h) for a in ("ij,ik", "jk,ij", "ik,jk"))
    f4 = -6 * g4
    for a in ("ij,ikl", "ik,ijl", "il,ijk", "jk,ijl", "jl,ijk", "kl,ijk"):
        f4 += np.einsum(f"{a}->ijkl", one, g3)
    for a in ("ijk,il", "ijl,ik", "ikl,ij", "jkl,ij"):
        f4 -= np.einsum(f"{a}->ijkl", three, h)
    for a in ("ij,kl,ik", "ik,jl,ij", "il,jk,ij"):
        f4 -= np.einsum(f"{a}->ijkl", one, one, h)
    q = np.linalg.inv(h)
    v = np.einsum("ijk,jk->i", f3, q)
    return float(
        np.einsum("ijkl,ij,kl", f4, q, q) / 8
        + v @ q @ v / 8
        + np.einsum("ijk,lmn,il,jm,kn", f3, f3, q, q, q) / 12
    )

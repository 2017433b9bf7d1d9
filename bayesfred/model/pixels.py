"""Which pixels of a frame enter the likelihood, and what is expected in all of them."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import spatial

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.kernels.contexts import SEGMENT, stride
from bayesfred.io.memory import require_room
from bayesfred.model.kernels.contexts import BACKGROUND_POWERS, LIMIT, MASKED, Frame
from bayesfred.model.noise import Noise, correlated_terms, model_error_terms
from bayesfred.model.parameters import Nuisances

OVERLAP = 12.0  # PSF widths beyond which sources have nothing to do with one another
BYTES_A_PAIR = 200.0  # that overlaps, in the search for the maximum
BRIGHT = 20.0  # standard deviations of a flux from which Laplace's approximation is enough
BLOCK = 2**21  # pixels of a large frame that are looked at together


class Expected(NamedTuple):
    """Expected counts; NaN where a map folds."""

    light: Floats  # (ny, nx) of the sources, counts per pixel
    level: Floats  # (ny, nx) of the background
    fluxes: Floats  # (s,) counts


def usable_pixels(
    model: ForwardModel,
    counts: Floats,
    mask: npt.ArrayLike | None,
    noise: Noise,
    nuisances: Nuisances,
) -> Flags:
    """The pixels for the likelihood, after checking that the frame can be explained at all.

    Parameters
    ----------
    model : ForwardModel
    counts : ndarray, shape (ny, nx), counts
    mask : array_like of bool, shape (ny, nx), optional
    noise : Noise
    nuisances : Nuisances

    Returns
    -------
    ndarray of bool, shape (ny, nx)

    Raises
    ------
    InputError
        If it cannot.
    """
    shape = model.detector.shape
    used = np.ones(shape, bool) if mask is None else np.array(mask, dtype=bool)
    for name, array in (("counts", counts), ("mask", used)):
        if array.shape != shape:
            raise InputError(f"{name}: got shape {array.shape}, expected the detector's {shape}")
    ny, nx = model.detector.fine_shape
    sources = model.sources
    inside = int(np.sum((np.abs(sources.x) <= 0.5 * nx) & (np.abs(sources.y) <= 0.5 * ny)))
    if not inside:
        raise InputError(
            f"catalogue: got {len(sources)} sources, all outside the frame of {nx} x {ny} pixels, "
            "expected positions in pixels from the frame's middle: check the columns, their unit "
            "and their origin"
        )
    positions = np.stack([sources.x, sources.y], axis=1)
    tree = spatial.cKDTree(positions)
    pairs = (int(tree.count_neighbors(tree, OVERLAP * model.psf.sigma)) - len(sources)) // 2
    require_room(
        f"catalogue: got {pairs} pairs of sources that overlap, whose fit",
        BYTES_A_PAIR * pairs,
        "leave out the faintest, or merge sources that the PSF does not separate",
    )
    if nuisances.footprint is not None:
        used &= footprints(model.detector, positions, nuisances.footprint)
    if not used.any():
        raise InputError(
            "counts: every pixel is masked, expected pixels to fit: check the mask and the "
            "footprint"
        )
    if nuisances.flux == "free" and inside > used.sum():
        raise InputError(
            f"nuisances: flux: got {inside} free fluxes in the frame and {used.sum()} pixels, "
            "expected fewer fluxes than pixels: leave out the faintest sources"
        )
    n_bad = int(np.sum(used & ~np.isfinite(counts)))
    if n_bad:
        raise InputError(
            f"counts: got {n_bad} pixels that are not finite, expected numbers: mask them"
        )
    if nuisances.model_error and noise.at(np.s_[:1]).highest(np.ones((1, used.shape[1]))) is None:
        raise InputError(
            f"nuisances: model_error: got it with {type(noise).__name__}, expected PoissonNoise or "
            "GaussianNoise"
        )
    noise.check(counts, used, nuisances.flux, nuisances.background_order)
    return used


def footprints(detector: Detector, positions: Floats, radius: float) -> Flags:
    """Pixels within `radius` of a position.

    Parameters
    ----------
    detector : Detector
    positions : ndarray, shape (n, 2), fine pixel
        From the middle of the frame; nan where there is none.
    radius : float, fine pixel

    Returns
    -------
    ndarray of bool, shape (ny, nx)
    """
    u, v = detector.pixel_centres()
    inside = np.zeros((v.size, u.size), bool)
    for x, y in positions:
        across, along = np.abs(u - x) <= radius, np.abs(v - y) <= radius
        near = (u[across] - x) ** 2 + (v[along, None] - y) ** 2 <= radius**2
        inside[np.ix_(along, across)] |= near
    return inside


def padded_frame(counts: Floats, mask: Flags, noise: Noise, nuisances: Nuisances) -> Frame:
    """The counts as the compiled loops need them; `mask` says which pixels are used."""
    ny, nx = counts.shape
    values = np.full((ny, stride(nx)), MASKED)
    np.copyto(values[:, :nx], counts, where=mask)
    used = (values > LIMIT).reshape(-1, SEGMENT)
    total = values.reshape(-1, SEGMENT).sum(axis=1, where=used)
    varies, alone = nuisances.background_order > 0, noise.pixelwise
    terms = alone.terms(values)
    everywhere = varies or not hasattr(terms, "unreached")
    if not everywhere:
        terms = alone.with_unreached(terms, values)
    if nuisances.model_error:
        terms = model_error_terms(alone, terms, stride(nx), counts, mask)
    return Frame(
        values.ravel(), used.sum(axis=1).astype(float), total, float(used.sum()),
        float(total.sum()), ny, nx, correlated_terms(noise, terms), varies, everywhere,
    )  # fmt: skip


def polynomial_background(shape: tuple[int, ...], coefficients: Floats) -> Floats:
    """The background polynomial, shape (ny, nx), counts per pixel, not to be written to."""
    out = np.broadcast_to(coefficients[0], shape)
    if not np.any(coefficients[1:]):
        return out
    out, (u, v) = out.copy(), (np.arange(1 - n, n, 2) / n for n in shape[::-1])
    for (m, n), value in zip(BACKGROUND_POWERS[1:], coefficients[1:], strict=True):
        if value:
            out += value * u**m * v[:, None] ** n
    return out


def faint_fluxes(model: ForwardModel, counts: Floats, used: Flags, noise: Noise) -> Flags:
    """Fluxes of fewer than `BRIGHT` standard deviations, by catalogue and frame.

    Parameters
    ----------
    model : ForwardModel
    counts : ndarray, shape (ny, nx), counts
    used : ndarray of bool, shape (ny, nx)
    noise : Noise

    Returns
    -------
    ndarray of bool, shape (s,)
    """
    flux = model.sources.flux
    with np.errstate(all="ignore"):  # at a mean of zero
        positive = np.maximum(counts, 0.0)
        variance = float(np.median(noise.counts_variance(positive, positive)[used]))
    area = 4.0 * np.pi * (model.psf.sigma / model.detector.binning) ** 2
    return np.asarray(flux**2 < BRIGHT**2 * (flux + area * variance))


def counts_constant(counts: Floats, used: Flags, noise: Noise) -> float:
    """The part of the log-likelihood that depends on the counts alone.

    Parameters
    ----------
    counts : ndarray, shape (ny, nx), counts
    used : ndarray of bool, shape (ny, nx)
    noise : Noise

    Returns
    -------
    float
    """
    rows = max(1, BLOCK // used.shape[1])
    some = (slice(k, k + rows) for k in range(0, len(used), rows))
    return sum(noise.at(s).constant(counts[s], used[s]) for s in some)

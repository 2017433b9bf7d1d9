"""The structure of a frame's background: ghosts, scattered light, whatever no polynomial follows.

Pixels outside the footprints are in no likelihood. A surface of cubic B-splines is fitted to them,
with knots at every s pixels, s being the scale, and the penalty (s/2)^4 int (f_uu^2 + f_vv^2):
second differences of the coefficients tell f_uu and f_vv. Where all pixels count a wave along an
axis, of wave number k, passes by about 1 / (1 + (s k / 2)^4), a half of one that is pi s long;
within the footprints the surface goes on as the penalty lets it. Pixels that lie far off, such as
stars that the catalogue lacks, and those beside them are left out, until hardly any change; so are
parts of the frame that no light reaches, such as dark edges. What exceeds the lowest background is
subtracted; the rest is the posterior's own.

References
----------
P. H. C. Eilers, I. D. Currie & M. Durban (2006), Computational Statistics & Data Analysis 50, 61:
penalised splines on large grids.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage, sparse, spatial
from scipy.interpolate import BSpline
from scipy.sparse.linalg import cg

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.model.noise import (
    CorrelatedNoise,
    FlatFieldNoise,
    GaussianNoise,
    Noise,
    PoissonNoise,
    SubtractedNoise,
)
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate

DEGREE = 3  # of the splines
BAND = 2 * DEGREE + 1  # splines that overlap one, along an axis
NOTICEABLE = 5.0  # standard deviations of the sum of squares
UNLIT = 0.2  # of the lowest background in use
AROUND = 7  # pixels a side of a square
SURE = 5.0  # standard deviations of a square's mean
STIFF = 0.5  # of the scale, over which the surface does not bend
CLIP = 3.0  # standard deviations off the surface
FEW = 1e-3  # of the pixels, which may still change
ROUNDS = 20  # of leaving out
MAD = 0.6745  # median of the size of a normal number
RESIDUAL, TURNS = 1e-6, 5000  # of conjugate gradients
FEWEST = 30  # pixels that tell a background
LARGEST = 50_000_000  # pixels of a frame, where nobody asked for it
MOST = 200_000  # splines, whose equations take over half a GiB


def subtract_background(posterior: Posterior, estimate: MapEstimate, scale: float) -> Posterior:
    """Measure the structure of the background outside the footprints, and subtract it.

    Parameters
    ----------
    posterior : Posterior
        With its footprints in the mask, as `follow_images` puts them there.
    estimate : MapEstimate
        Its maximum, for the background that lit pixels have.
    scale : float, pixel
        Distance of the splines' knots: waves shorter than three times that are lost. A third to a
        half of the distance between sources is a good choice.

    Returns
    -------
    Posterior
        Its counts lack what the background is above its lowest value, and its noise knows that.
        Errors of the measurement are not included; it is of pixels that are in no likelihood.

    Raises
    ------
    InputError
        If the scale is below a pixel, or too small or large for the frame; if too few pixels lie
        outside the footprints; if the noise is neither `PoissonNoise`, `FlatFieldNoise` nor
        `GaussianNoise`.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((90, 90)), bf.SourceCatalog.grid(3, 25.0, 1e4), bf.GaussianPSF(1.5),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> counts = bf.simulate(model, [1e-4], 20.0, seed=1)
    >>> scattered = 20.0 * (1.0 + np.sin(np.arange(90) / 9.0))
    >>> counts += np.random.default_rng(2).poisson(scattered, counts.shape)
    >>> posterior = bf.follow_images(bf.Posterior(
    ...     model, counts, nuisances=bf.Nuisances("free", footprint=8.0)))
    >>> estimate = bf.find_map(posterior)
    >>> even = subtract_background(posterior, estimate, 8.0)
    >>> estimate.fits_data, bf.find_map(even).fits_data
    (False, True)
    """
    if not 1.0 <= scale <= max(posterior.mask.shape):
        raise InputError(
            f"background_scale: got {scale:g}, expected pixels, at least 1 and no more than the "
            f"frame's {max(posterior.mask.shape)}"
        )
    noise = posterior.noise.pixelwise
    if not isinstance(noise, PoissonNoise | FlatFieldNoise | GaussianNoise):
        raise InputError(
            f"background_scale: got {type(noise).__name__}, whose variance would change with what "
            "is subtracted, expected PoissonNoise, FlatFieldNoise or GaussianNoise"
        )
    level = _surface(posterior, estimate.params, scale)
    lowest = max(float(level[posterior.mask].min()), 0.0)
    light = level - lowest
    if not isinstance(noise, GaussianNoise):
        light = np.maximum(light, 0.0)  # expected of photons
        noise = SubtractedNoise(noise, light)
    if isinstance(posterior.noise, CorrelatedNoise):
        noise = replace(posterior.noise, noise=noise)
    return replace(posterior, counts=posterior.counts - light, noise=noise, extrapolation=None)


class Structure(NamedTuple):
    """What the pixels outside the footprints show beyond a posterior's background.

    Attributes
    ----------
    scale : float, pixel
        Half the distance between neighbouring images: no finer structure is seen between them.
    counts : ndarray, shape (ny, nx), counts per pixel
    """

    scale: float
    counts: Floats


def structure_outside(posterior: Posterior, params: Floats) -> Structure | None:
    """The structure of the background outside the footprints, if there are pixels that tell it.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)

    Returns
    -------
    Structure or None
    """
    images = posterior.likelihood.image_positions(params) / posterior.model.detector.binning
    half = 0.5 * np.array(posterior.mask.shape[::-1])
    images = images[(np.abs(images) <= half).all(axis=1)]
    large = posterior.mask.size > LARGEST
    if large or len(images) < 2 or np.array_equal(posterior.valid, posterior.mask):
        return None
    apart = spatial.cKDTree(images).query(images, 2)[0][:, 1]
    scale = float(f"{max(0.5 * np.median(apart), 1.0):.2g}")
    try:
        level = _surface(posterior, params, scale)
    except InputError:  # too few pixels, or too many splines
        return None
    return Structure(scale, level - posterior.likelihood.background(params))


def background_message(posterior: Posterior, params: Floats) -> str:
    """Say in a line how the background outside the footprints differs, where that would matter.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)

    Returns
    -------
    str
        Empty where the sum of squares over the pixels in use would hardly show it.
    """
    found = structure_outside(posterior, params)
    if found is None:
        return ""
    used, level = posterior.mask, params[posterior.parameter_names.index("background")]
    mean = posterior.expected_counts(params)
    weight = 1.0 / posterior.noise_at(params).counts_variance(mean, level)[used]
    counts = found.counts[used] - np.average(found.counts[used], weights=weight)
    if not np.sum(weight * counts**2) > NOTICEABLE * (2.0 * counts.size) ** 0.5:
        return ""
    return (
        f"background: outside the footprints it differs from the model's by {counts.std():.2g} "
        "counts a pixel (root mean square), from one part of the frame to another: "
        f"frame.background_scale = {found.scale:g} subtracts that"
    )


def _lit(posterior: Posterior, params: Floats) -> Flags:
    """The pixels in no square without light, by the background of those in use, (ny, nx)."""
    least = float(posterior.likelihood.background(params)[posterior.mask].min())
    noise = posterior.noise.pixelwise
    variance = noise.counts_variance(np.full(posterior.mask.shape, max(least, 0.0)), 0.0)
    if not (1.0 - UNLIT) * least > SURE * np.median(variance) ** 0.5 / AROUND:
        return np.ones(posterior.mask.shape, bool)  # so little light that none is like it
    seen = posterior.valid.astype(float)
    light = ndimage.uniform_filter(np.where(posterior.valid, posterior.counts, 0.0), AROUND)
    unlit = light < UNLIT * least * ndimage.uniform_filter(seen, AROUND)
    return np.asarray(~ndimage.binary_dilation(unlit, np.ones((AROUND, AROUND), bool)))


def _surface(posterior: Posterior, params: Floats, scale: float) -> Floats:
    """The background that the pixels outside the footprints tell, everywhere, shape (ny, nx)."""
    outside = posterior.valid & ~posterior.mask & _lit(posterior, params)
    return _smooth(posterior.counts, outside, posterior.noise.pixelwise, scale)


def _smooth(counts: Floats, outside: Flags, noise: Noise, scale: float) -> Floats:
    """The surface through some pixels, everywhere, shape (ny, nx)."""
    rows, columns = (_splines(size, scale) for size in counts.shape)
    if rows.shape[1] * columns.shape[1] > MOST:
        raise InputError(
            f"background_scale: got {scale:g} pixels, for which {rows.shape[1]} x "
            f"{columns.shape[1]} splines would be needed, expected a wider one"
        )
    start, kept = None, outside
    for _ in range(ROUNDS):
        if kept.sum() < FEWEST:
            raise InputError(
                f"background_scale: got {kept.sum()} pixels outside the footprints, expected "
                "more: narrow nuisances.footprint, or leave background_scale out"
            )
        level, start = _fitted(counts, kept, rows, columns, scale, start)
        off = (counts - level) / np.sqrt(noise.counts_variance(np.maximum(level, 0.0), 0.0))
        # in units of what they scatter by, whatever the noise says
        wider = max(float(np.median(np.abs(off[outside]))) / MAD, 1.0)
        far = ndimage.binary_dilation(outside & (np.abs(off) > CLIP * wider), np.ones((3, 3), bool))
        before, kept = kept, outside & ~far
        if np.sum(kept != before) <= FEW * np.sum(kept):
            break
    return level


def _splines(size: int, scale: float) -> sparse.csr_array:
    """The splines along an axis at its pixels, shape (size, splines)."""
    pieces = max(math.ceil((size - 1) / scale), 1)
    knots = np.arange(-DEGREE, pieces + DEGREE + 1.0)
    at = np.linspace(0.0, pieces, size)
    return sparse.csr_array(BSpline.design_matrix(at, knots, DEGREE))


def _fitted(
    counts: Floats,
    outside: Flags,
    rows: sparse.csr_array,
    columns: sparse.csr_array,
    scale: float,
    start: Floats | None,
) -> tuple[Floats, Floats]:
    """The penalised surface of least squares.

    A pixel's products of two splines are those along its row times those along its column, so that
    the equations are the pixels' weights between two sparse matrices.
    """
    (m, n), (ny, nx) = (rows.shape[1], columns.shape[1]), counts.shape
    weight = outside.astype(float)
    found = sparse.coo_array(_between(_products(rows), weight, _products(columns)))
    (i, across), (j, along) = (np.divmod(at, BAND) for at in found.coords)
    others = (i + across - DEGREE) * n + j + along - DEGREE
    matrix = sparse.csr_array((found.data, (i * n + j, others)), shape=(m * n, m * n))
    spacing_v, spacing_u = max(ny - 1, 1) / (m - DEGREE), max(nx - 1, 1) / (n - DEGREE)
    area = spacing_u * spacing_v
    bent_v, bent_u = _bending(m), _bending(n)
    matrix += area * (STIFF * scale / spacing_v) ** 4 * sparse.kron(bent_v, sparse.eye_array(n))
    matrix += area * (STIFF * scale / spacing_u) ** 4 * sparse.kron(sparse.eye_array(m), bent_u)
    pull = _between(rows, weight * counts, columns).ravel()
    nearly = sparse.diags_array(1.0 / matrix.diagonal())
    solution, unfinished = cg(matrix, pull, start, rtol=RESIDUAL, M=nearly, maxiter=TURNS)
    if unfinished:
        raise InputError(
            f"background_scale: got {scale:g} pixels, for which no surface was found in {TURNS} "
            "turns of conjugate gradients, expected a wider one"
        )
    return np.asarray(rows @ (columns @ solution.reshape(m, n).T).T), solution


def _between(left: sparse.csr_array, image: Floats, right: sparse.csr_array) -> Floats:
    """left^T image right."""
    return np.asarray(left.T @ (right.T @ image.T).T)


def _products(splines: sparse.csr_array) -> sparse.csr_array:
    """The products of every spline with those that overlap it, shape (size, splines * BAND)."""
    size, count = splines.shape
    which = splines.indices.reshape(size, DEGREE + 1)
    values = splines.data.reshape(size, DEGREE + 1)
    column = which[:, :, None] * BAND + which[:, None] - which[:, :, None] + DEGREE
    products = values[:, :, None] * values[:, None]
    row = np.broadcast_to(np.arange(size)[:, None, None], products.shape)
    coordinates = row.ravel(), column.ravel()
    return sparse.csr_array((products.ravel(), coordinates), shape=(size, count * BAND))


def _bending(count: int) -> sparse.csr_array:
    """The sum of squares of the second differences of that many numbers, as a matrix."""
    ones = np.ones(count)
    second = sparse.dia_array(
        (np.stack([ones, -2.0 * ones, ones]), [0, 1, 2]), shape=(count - 2, count)
    )
    return sparse.csr_array(second.T @ second)

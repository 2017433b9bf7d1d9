"""The pixels that measure a PSF: which sources reach them, and where in the PSF they lie."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.optimize import brentq

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.model.kernels.contexts import BACKGROUND_POWERS
from bayesfred.model.kernels.psf_samples import SourceSamples, find_samples
from bayesfred.model.parameters import displacing
from bayesfred.model.posterior import Posterior

OUTLYING = 6.0  # standard deviations beyond which a pixel counts less
DIMMEST = 1e-3  # counts that a pixel expects at the least: splines swing below zero


@dataclass(frozen=True, eq=False)
class PsfSamples:
    """All pairs of a source and a pixel within some radius of its image, sorted by pixel.

    Attributes
    ----------
    samples : SourceSamples
        For the compiled loops.
    pixel : ndarray, shape (pixels,)
        The pixels' numbers, row nx + column: those with samples, then those without, which know
        the background.
    owner : ndarray, shape (samples,)
        Which of these pixels a sample lies in.
    counts : ndarray, shape (pixels,), counts
    background : ndarray, shape (pixels, terms)
        The background's terms that are free.
    """

    samples: SourceSamples
    pixel: Ints
    owner: Ints
    counts: Floats
    background: Floats

    @classmethod
    def at(
        cls, posterior: Posterior, params: Floats, shifts: Floats, radius: float
    ) -> "PsfSamples":
        """The samples of a posterior's frame where `params` put the images.

        Parameters
        ----------
        posterior : Posterior
        params : ndarray, shape (d,)
        shifts : ndarray, shape (s, 2), pixel
            Of every source along a and b.
        radius : float, pixel
            Largest distance in (a, b).

        Returns
        -------
        PsfSamples
        """
        model, mask = posterior.model, posterior.mask
        s, (ny, nx) = model.sources, mask.shape
        theta, offset = displacing(posterior.parameters, params)
        theta = model.polynomial.monomial_coefficients(theta.copy())
        imaged = posterior.likelihood.image_positions(params) + shifts
        first, numbers, samples = find_samples(
            (_map_coefficients(model.polynomial, theta, s.x, s.y, offset, axis=0),
             _map_coefficients(model.polynomial, theta, s.x, s.y, offset, axis=1)),
            imaged, shifts, mask, radius, model.conserve_flux,
        )  # fmt: skip
        dark = mask.ravel().copy()
        dark[numbers] = False
        beyond = np.flatnonzero(dark)
        numbers = np.append(numbers, beyond)
        first = np.append(first, np.full(beyond.size, first[-1]))
        samples = SourceSamples(first, *samples)
        owner = np.repeat(np.arange(numbers.size), np.diff(first))
        middle = 0.5 * np.array([nx - 1, ny - 1])
        free = [p.slot for p in posterior.parameters if p.kind == "background"]
        powers = [BACKGROUND_POWERS[slot] for slot in free]
        s_u, s_v = (numbers % nx - middle[0]) * 2 / nx, (numbers // nx - middle[1]) * 2 / ny
        terms = np.stack([s_u**m * s_v**n for m, n in powers], axis=1)
        return cls(
            samples, numbers, owner, posterior.counts.ravel()[numbers].astype(np.float64), terms
        )

    def residual(
        self, posterior: Posterior, params: Floats, light: Floats
    ) -> tuple[Floats, Floats]:
        """Counts less background and the sources' light, and their variance, shape (pixels,)."""
        expected = posterior.likelihood.background(params)
        expected.ravel()[self.pixel] += light
        level = params[posterior.parameter_names.index("background")]
        variance = posterior.noise.counts_variance(np.maximum(expected, DIMMEST), level)
        variance = np.broadcast_to(variance, expected.shape).ravel()[self.pixel]
        return self.counts - expected.ravel()[self.pixel], variance

    def image(self, values: Floats) -> Floats:
        """The sum over every pixel's samples, shape (pixels,)."""
        return np.asarray(np.bincount(self.owner, values, self.pixel.size), dtype=np.float64)


def _map_coefficients(
    distortion: PolynomialDistortion,
    theta: Floats,
    x: Floats,
    y: Floats,
    offset: Floats,
    *,
    axis: int,
) -> Floats:
    """a of every source in powers of u and v, shape (s, n, n); or b, along axis 1."""
    first = len(distortion.f_terms)
    terms = (distortion.g_terms, theta[first:]) if axis else (distortion.f_terms, theta[:first])
    every = distortion.f_terms + distortion.g_terms
    out = np.zeros((x.size, *(max(1, max(m + n for _, _, m, n in every)) + 1,) * 2))
    out[:, 0, 0] = -(y if axis else x) - offset[axis]
    out[:, 1 - axis, axis] = 1.0
    for (i, j, m, n), coefficient in zip(*terms, strict=True):
        out[:, m, n] += coefficient * x**i * y**j
    return out


def source_columns(posterior: Posterior, params: Floats, fluxes: Floats) -> Floats:
    """How the parameters act on the sources' templates, shape (3 s, d).

    The templates of a source are its kernel, and its light's derivatives as it is shifted along a
    and along b: K, X and Y. Over a source's image f and g are taken to change with a coefficient as
    they do in its middle. Parameters that act on no template, and those that are not solved for
    together with a PSF, have a column of zeros.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    fluxes : ndarray, shape (s,), counts

    Returns
    -------
    ndarray, shape (3 s, d)
    """
    model = posterior.model
    s, images = model.sources, posterior.likelihood.image_positions(params)
    u, v = np.where(np.isfinite(images), images, 0.0).T
    out = np.zeros((len(s), 3, posterior.n_parameters))
    theta = [k for k, p in enumerate(posterior.parameters) if p.kind == "distortion"]
    out[:, 1:, theta] = -np.moveaxis(model.polynomial.design_matrix(u, v, s.x, s.y), 0, 1)
    for k, name in enumerate(posterior.parameter_names):
        if name in ("offset_x", "offset_y"):
            out[:, 1 + (name == "offset_y"), k] = 1.0
        elif name == "flux_scale":
            out[:, 0, k] = fluxes / params[k]
    return out.reshape(3 * len(s), -1)


def template_products(
    data: PsfSamples, templates: Floats, weight: Floats, sources: int
) -> tuple[sparse.csc_array, Floats]:
    """The templates' information, shape (3 s, 3 s), and what they share with the background.

    Parameters
    ----------
    data : PsfSamples
    templates : ndarray, shape (3, samples)
    weight : ndarray, shape (pixels,)
    sources : int
        How many there are in the catalogue.

    Returns
    -------
    information : sparse array, shape (3 s, 3 s)
    coupling : ndarray, shape (3 s, terms)
    """
    source = data.samples.source
    columns = np.concatenate([3 * source + k for k in range(3)])
    rows = np.tile(data.owner, 3)
    shape = data.pixel.size, 3 * sources
    design = sparse.csr_array((templates.ravel(), (rows, columns)), shape)
    weighed = (design.multiply(weight[:, None])).tocsr()
    return (design.T @ weighed).tocsc(), weighed.T @ data.background


def template_pulls(data: PsfSamples, templates: Floats, score: Floats, sources: int) -> Floats:
    """The slope of the log-likelihood by every template, shape (3 s,), given that by every pixel.

    Parameters
    ----------
    data : PsfSamples
    templates : ndarray, shape (3, samples)
    score : ndarray, shape (pixels,)
    sources : int
        How many there are in the catalogue.

    Returns
    -------
    ndarray, shape (3 s,)
    """
    source, each = data.samples.source, score[data.owner]
    pulls = [np.bincount(source, template * each, sources) for template in templates]
    return np.asarray(np.stack(pulls, axis=1).ravel(), dtype=np.float64)


def likely_error(residual: Floats, variance: Floats, light: Floats) -> float:
    """The most likely share of the light by which the model is off; 0 if the noise explains all.

    Of the pixels in which the light exceeds the noise: what else is wrong in the others, such as
    the background, would make it many times the light.

    Parameters
    ----------
    residual, variance, light : ndarray, shape (pixels,)

    Returns
    -------
    float
    """
    seen = light**2 > variance
    residual, variance, light = residual[seen], variance[seen], light[seen]

    def excess(error: float) -> float:
        total = variance + (error * light) ** 2
        z = np.minimum(residual**2 / total, OUTLYING**2)
        return float(np.sum(light**2 / total * (z - 1.0)))

    # the score of the squared error, in its standard deviations
    if excess(0.0) <= 3.0 * math.sqrt(2.0 * float(np.sum((light**2 / variance) ** 2))):
        return 0.0
    return float(brentq(excess, 0.0, 10.0, xtol=1e-4)) if excess(10.0) < 0.0 else 10.0

"""The pixels that measure a PSF: which sources reach them, and where in the PSF they lie."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from bayesfred._typing import Floats, Ints
from bayesfred.model.kernels.psf_normal import SourceSamples
from bayesfred.model.parameters import BACKGROUND_POWERS, displacing
from bayesfred.model.posterior import Posterior

DIMMEST = 1e-3  # counts that a pixel expects at the least: splines swing below zero
LARGEST_SCALE = 1.25  # a window is so much larger than the PSF, for images that are magnified


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
        model = posterior.model
        theta, offset = displacing(posterior.parameters, params)
        d, s = model.polynomial, model.sources
        ny, nx = model.detector.shape
        middle = 0.5 * np.array([nx - 1, ny - 1])
        imaged = posterior.likelihood.image_positions(params) + shifts
        half = int(np.ceil(LARGEST_SCALE * radius))
        steps = np.arange(-half, half + 1)
        known = np.asarray(np.isfinite(imaged).all(axis=1))
        nearest = np.round(np.where(known[:, None], imaged, 0.0) + middle).astype(np.int64)
        columns = nearest[:, 0, None, None] + steps
        rows = nearest[:, 1, None, None] + steps[:, None]
        columns, rows = np.broadcast_arrays(columns, rows)
        inside = (columns >= 0) & (columns < nx) & (rows >= 0) & (rows < ny)
        inside &= known[:, None, None]
        inside[inside] = posterior.mask[rows[inside], columns[inside]]
        source = np.nonzero(inside)[0]
        column, row = columns[inside], rows[inside]
        u, v = column - middle[0], row - middle[1]
        x, y = s.x[source], s.y[source]
        f, g = d.displacement(theta, u, v, x, y)
        a, b = u - x + f - offset[0] - shifts[source, 0], v - y + g - offset[1] - shifts[source, 1]
        near = a**2 + b**2 <= radius**2
        pixel = (row * nx + column)[near]
        order = np.argsort(pixel, kind="stable")
        numbers, first = np.unique(pixel[order], return_index=True)
        near = np.flatnonzero(near)[order]
        size = np.ones(near.size)
        if model.conserve_flux:
            size = np.abs(d.determinant(theta, u[near], v[near], x[near], y[near]))
        first = np.append(first, near.size)
        dark = posterior.mask.ravel().copy()
        dark[numbers] = False
        beyond = np.flatnonzero(dark)
        numbers = np.append(numbers, beyond)
        first = np.append(first, np.full(beyond.size, first[-1]))
        samples = SourceSamples(first, source[near], a[near], b[near], size)
        owner = np.repeat(np.arange(numbers.size), np.diff(first))
        free = [p.slot for p in posterior.parameters if p.kind == "background"]
        powers = [BACKGROUND_POWERS[slot] for slot in free]
        s_u, s_v = (numbers % nx - middle[0]) * 2 / nx, (numbers // nx - middle[1]) * 2 / ny
        terms = np.stack([s_u**m * s_v**n for m, n in powers], axis=1)
        return cls(samples, numbers, owner, posterior.counts.ravel()[numbers], terms)

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
    data: PsfSamples, templates: Floats, weight: Floats, residual: Floats, sources: int
) -> tuple[sparse.csc_array, Floats, Floats]:
    """The templates' information, shape (3 s, 3 s), with the background, and their pull.

    Parameters
    ----------
    data : PsfSamples
    templates : ndarray, shape (3, samples)
    weight, residual : ndarray, shape (pixels,)
    sources : int
        How many there are in the catalogue.

    Returns
    -------
    information : sparse array, shape (3 s, 3 s)
    coupling : ndarray, shape (3 s, terms)
    pull : ndarray, shape (3 s,)
    """
    source = data.samples.source
    columns = np.concatenate([3 * source + k for k in range(3)])
    size = 3 * sources
    rows = np.tile(data.owner, 3)
    design = sparse.csr_array((templates.ravel(), (rows, columns)), (data.pixel.size, size))
    weighed = (design.multiply(weight[:, None])).tocsr()
    return (design.T @ weighed).tocsc(), weighed.T @ data.background, weighed.T @ residual

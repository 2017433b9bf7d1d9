r"""The likelihood of a frame as a function of its sources' positions, too.

A catalogue's position enters the likelihood like a coefficient of the distortion: at fixed (u, v)

    da/dx = -1 + f_x(u, v, x, y),    db/dx = g_x(u, v, x, y),

polynomials in u and v whose monomials are those of f and g. The compiled gradient has a sum over
every source's own pixels for every monomial, which make the exact derivatives by all parameters and
positions.

The information is that of the sources' templates (`kernels.sources`): light S, its derivatives X
and Y along a and b, and dS/dln(sigma). A change of a parameter or a position changes the
coefficients c of the templates by R, the Jacobian of (a, b) in the middle of the image, so with the
matrix of the templates T, weights w and the background's terms among the templates the information
is R^T (T^T w T) R. What a change does to the shape of an image is left out. Fluxes are eliminated:
T^T w T couples sources that share pixels, and no others, so everything is sparse.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.inverse import slopes
from bayesfred.model.kernels.contexts import BACKGROUND_POWERS
from bayesfred.model.kernels.gradient import from_sources
from bayesfred.model.likelihood import FrameLikelihood

WIDTHS = 4.0  # radius of the pixels that tell of a source, in widths of the PSF
REACH = 0.75  # pixel, added so that the pixel of the image's middle is always among them
OF_COUNTS = ("_frame", "_constant", "_faint", "_workspaces")  # what positions do not change

Matrix = Any  # scipy.sparse has no types


@dataclass(frozen=True, eq=False)
class MovableLikelihood(FrameLikelihood):
    """Likelihood of a frame whose sources may be moved; `FrameLikelihood` has the parameters.

    Fluxes are free. A PSF that varies over the field stays that of the positions at the beginning.
    """

    @classmethod
    def of(cls, likelihood: FrameLikelihood) -> Self:
        """The same likelihood.

        Parameters
        ----------
        likelihood : FrameLikelihood

        Returns
        -------
        MovableLikelihood
        """
        return cls(*(getattr(likelihood, field.name) for field in fields(likelihood)))

    def moved(self, positions: Floats) -> Self:
        """The likelihood of the same counts with the sources elsewhere.

        Parameters
        ----------
        positions : ndarray, shape (s, 2), fine pixel

        Returns
        -------
        MovableLikelihood
        """
        catalog = SourceCatalog(positions[:, 0], positions[:, 1], self.model.sources.flux)
        model = replace(self.model, sources=catalog)
        other = replace(self, model=model)
        optics = model.optics(self.narrowest)._replace(psf=self._optics.psf)
        kept = {name: getattr(self, name) for name in OF_COUNTS}
        other.__dict__.update(kept, _optics=optics)
        return other

    def gradients(self, params: Floats) -> tuple[Floats, Floats]:
        """Exact derivatives of the log-likelihood.

        Parameters
        ----------
        params : ndarray, shape (d,)

        Returns
        -------
        by_params : ndarray, shape (d,)
        by_position : ndarray, shape (s, 2), per fine pixel
            NaN, both, where the likelihood is zero.
        """
        s, field = self.model.sources, self.model.polynomial
        whole = self.model.basis(("offset_x", "offset_y", *self._moving))
        parts, others, *_ = self.slopes(params, whole)
        if np.isnan(others[0]):
            return np.full(params.size, np.nan), np.full((len(s), 2), np.nan)
        sums = parts[:, whole.row]
        terms = np.array([*field.f_terms, *field.g_terms])[:, :2]
        kept = [*range(len(terms)), *range(len(terms) + 2, whole.row.size)]  # all but the offsets
        by = from_sources(whole, parts)[kept]
        by_params = np.append(by, others) @ self._chain_rule(params)
        theta = field.monomial_coefficients(params[: field.n_terms])
        by_position = sums[:, len(terms) : len(terms) + 2] * -1.0
        for axis in (0, 1):
            change = theta * _power_slopes(terms, (s.x, s.y), axis)
            by_position[:, axis] += (sums[:, : len(terms)] * change).sum(axis=1)
        return np.asarray(by_params), by_position

    def template_information(self, params: Floats) -> Matrix:
        """Information about parameters and positions, the fluxes eliminated with their prior.

        Parameters
        ----------
        params : ndarray, shape (d,)
            With a positive likelihood.

        Returns
        -------
        sparse matrix, shape (d + 2 s, d + 2 s)
            Of the parameters, then of every source's x and y.

        Raises
        ------
        InputError
            Where the likelihood is zero because the map folds.
        """
        names = [parameter.name for parameter in self.parameters]
        sigma = params[names.index("psf_sigma")] if "psf_sigma" in names else self.model.psf.sigma
        radius = WIDTHS * float(sigma) + REACH * self.model.detector.binning
        own, expected, _, _ = self.own_pixels(params, radius)
        noise, level = self.noise_at(params), params[names.index("background")]
        weight = np.broadcast_to(noise.fisher_weight(expected, level), self.mask.shape)
        weight = np.where(self.mask, weight, 0.0).ravel()
        size, pixels = own.first.size - 1, weight.size
        templates = own.templates if "psf_sigma" in names else own.templates[:3]
        light, weighted = (
            sparse.hstack(
                [sparse.csc_matrix((t, own.pixel, own.first), (pixels, size)) for t in each]
            )
            for each in (templates, templates * weight[own.pixel])
        )
        level_terms = self._background_terms()
        beside = weighted.T @ level_terms
        gram = sparse.bmat(
            [
                [light.T @ weighted, beside],
                [beside.T, level_terms.T @ (weight[:, None] * level_terms)],
            ]
        ).tocsr()
        response = self._responses(params, np.nan_to_num(own.image), len(templates))
        pull = (gram @ response).tocsr()
        free = gram[:size, :size] + self.nuisances.flux_shape * sparse.identity(size)
        cross = pull[:size]
        known = response.T @ pull - cross.T @ (_inverse(free) @ cross)
        if "model_error" in names:  # the size of residuals tells of it, their sums do not
            k = names.index("model_error")
            at = ([self.fisher(params)[k, k]], ([k], [k]))
            known = known + sparse.csr_matrix(at, known.shape)
        return known.tocsr()

    def _responses(self, params: Floats, image: Floats, templates: int) -> Matrix:
        """Changes of the templates' coefficients, shape (templates s + terms, d + 2 s).

        The rows are S, X, Y and dS/dln(sigma) of all sources, and the background's terms.
        """
        s, field = self.model.sources, self.model.polynomial
        size, d, terms = len(s), params.size, len(self.nuisances.background_names)
        at = image[:, 0], image[:, 1], s.x, s.y
        dense = np.zeros((templates, size, d))
        level = np.zeros((terms, d))
        design = field.design_matrix(*at)
        for k, parameter in enumerate(self.parameters):
            if parameter.kind == "distortion":
                dense[1:3, :, k] = -design[:, :, parameter.slot]
            elif parameter.kind == "background":
                level[parameter.slot, k] = 1.0
            elif parameter.name == "psf_sigma":
                dense[3, :, k] = 1.0 / params[k]
        theta = field.monomial_coefficients(params[: field.n_terms])[None]
        split = len(field.f_terms)
        f, g = (theta[:, :split], field.f_terms), (theta[:, split:], field.g_terms)
        moves = -slopes(f, g, at, images=False)  # a shift of an image lowers a and b
        each = np.arange(size)
        rows = np.stack([each, each, size + each, size + each], axis=1)
        columns = np.stack([2 * each, 2 * each + 1] * 2, axis=1)
        shifts = sparse.csr_matrix(
            (moves.reshape(size, 4).ravel(), (rows.ravel(), columns.ravel())), (2 * size, 2 * size)
        )
        above, below = (
            sparse.csr_matrix((n, 2 * size)) for n in (size, (templates - 3) * size + terms)
        )
        positions = sparse.vstack([above, shifts, below])
        parameters = sparse.csr_matrix(np.vstack([dense.reshape(-1, d), level]))
        return sparse.hstack([parameters, positions]).tocsr()

    def _background_terms(self) -> Floats:
        """The background polynomial's terms in all pixels, shape (ny nx, terms)."""
        ny, nx = self.mask.shape
        v, u = np.arange(1 - ny, ny, 2)[:, None] / ny, np.arange(1 - nx, nx, 2) / nx
        powers = BACKGROUND_POWERS[: len(self.nuisances.background_names)]
        return np.stack([(u**m * v**n).ravel() for m, n in powers], axis=1)


def _power_slopes(powers: Ints, at: tuple[Floats, Floats], axis: int) -> Floats:
    """Derivatives of x^i y^j by x (axis 0) or y, shape (s, terms)."""
    lowered = powers.copy()
    lowered[:, axis] -= 1
    x, y = (p[:, None] for p in at)
    inner = np.maximum(lowered, 0)
    return np.asarray(powers[:, axis] * x ** inner[:, 0] * y ** inner[:, 1])


def _inverse(matrix: Matrix) -> Matrix:
    """Inverse of a sparse matrix of small blocks."""
    if matrix.nnz == matrix.shape[0]:
        return sparse.diags(1.0 / matrix.diagonal())
    return sparse.csr_matrix(splu(matrix.tocsc()).solve(np.eye(matrix.shape[0])))

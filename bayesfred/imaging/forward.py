"""The forward model: distortion coefficients to expected counts, and their derivatives.

    mu(u, v) = background + sum_s F_s p(u - x_s + f, v - y_s + g) |D|,
    D = (1 + f_u)(1 + g_v) - f_v g_u

|D| makes each source's kernel integrate to one over the image, the constraint that Sun & Zhou state
below their Eq. 1; their simulated kernel leaves it out, and so does `conserve_flux=False`. The sums
over pixels are in `kernels`; `model` compares the result with counts.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import Distortion, PolynomialDistortion
from bayesfred.imaging.kernels.contexts import Basis, Degrees, Optics, SourceNuisances, stride
from bayesfred.imaging.kernels.jacobian import jacobian
from bayesfred.imaging.kernels.render import render
from bayesfred.imaging.psf import FWHM, PSF, density_at, has_pixel, profile_of
from bayesfred.io.serialize import serializable

# An impulse-sampled Gaussian's counts ripple with its sub-pixel position by 4 exp(-2 pi^2 sigma^2):
# 1 % at this width.
NARROWEST_IMPULSE = math.sqrt(math.log(400.0) / (2.0 * math.pi**2))

WIDEST = 4.0  # sides of the frame; a PSF of this width differs by 1 % over the frame


def require_image(sigma: float, fine_shape: tuple[int, int], where: str = "") -> None:
    """Refuse a PSF so much wider than the frame that it is flat there.

    Parameters
    ----------
    sigma : float, fine pixel
    fine_shape : (int, int), fine pixel
    where : str
        What the line begins with.

    Raises
    ------
    InputError
    """
    if not sigma <= WIDEST * max(fine_shape):
        raise InputError(
            f"{where}psf: sigma: got {sigma:.4g} pixels in a frame of {max(fine_shape)}, expected "
            "images that the frame shows: check its unit, which is the pixel"
        )


@serializable("model")
@dataclass(frozen=True)
class ForwardModel:
    """Expected counts of a distorted field of point sources.

    Parameters
    ----------
    detector : Detector
        Geometry and pixel response of the recorded frame.
    sources : SourceCatalog
        Positions (pixel) and fluxes (counts) in the object plane.
    psf : PSF
        Reference PSF at the axis: `GaussianPSF`, `MoffatPSF`, `SampledPSF` or another family.
    distortion : Distortion
        The displacements f and g. One that is not a `PolynomialDistortion` can be simulated, not
        fitted: it has expected counts alone.
    conserve_flux : bool
        Whether the kernel carries |D|. False is the kernel as the paper prints it.
    tolerance : float
        Pixels where the PSF is below `tolerance` times its peak may be left out; 0 visits every
        pixel for every source.

    Raises
    ------
    InputError
        If the tolerance is outside [0, 1), the PSF is far wider than the frame, or it is too narrow
        to be sampled at pixel centres.

    References
    ----------
    Sun & Zhou, Eq. 1 and 3.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog([0.0], [0.0], [1e4]), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion.mirrored())
    >>> counts = model.expected_counts(np.zeros(12), background=2.0)
    >>> counts.shape, round(float(counts.sum() - 2 * 65**2), 3)
    ((65, 65), 10000.0)
    """

    detector: Detector
    sources: SourceCatalog
    psf: PSF
    distortion: Distortion
    conserve_flux: bool = field(default=True, kw_only=True)
    tolerance: float = field(default=1e-8, kw_only=True)

    def __post_init__(self) -> None:
        if not 0.0 <= self.tolerance < 1.0:
            raise InputError(f"model: tolerance: got {self.tolerance}, expected 0 <= tolerance < 1")
        require_image(self.psf.sigma, self.detector.fine_shape)
        if has_pixel(self.psf):
            if self.detector.pixel != "impulse" or self.detector.binning != 1:
                raise InputError(
                    "psf: got a measured PSF, which has the pixel's response in it, and a detector "
                    f"with pixel = {self.detector.pixel!r} and binning = {self.detector.binning}, "
                    "expected 'impulse' and 1"
                )
        elif self.detector.pixel == "impulse" and self.psf.sigma < NARROWEST_IMPULSE:
            raise InputError(
                f"psf: sigma: got {self.psf.sigma:.4g} pixel with pixel = 'impulse', narrower "
                "than the pixel: expected at least "
                f"{NARROWEST_IMPULSE:.2f} (a FWHM of {NARROWEST_IMPULSE * FWHM:.1f}), below which "
                "sampled flux depends on the "
                "sub-pixel position; use pixel = 'box'"
            )

    @property
    def polynomial(self) -> PolynomialDistortion:
        """The distortion, if it is one that can be fitted; an InputError otherwise."""
        if not isinstance(self.distortion, PolynomialDistortion):
            raise InputError(
                f"distortion: got {type(self.distortion).__name__}, expected "
                "PolynomialDistortion: no other can be fitted"
            )
        return self.distortion

    def optics(self, narrowest: float | None = None) -> Optics:
        """The model as the compiled loops need it.

        Pixels are integrated well for PSFs of widths down to `narrowest` (pixel).
        """
        if narrowest is None:
            return self._optics
        width, beta = self.psf.core
        offsets, weights = self.detector.quadrature(width * narrowest / self.psf.sigma, beta)
        return self._optics._replace(offsets=offsets, weights=weights)

    @cached_property
    def _optics(self) -> Optics:
        f = np.array(self.polynomial.f_terms, dtype=np.int64).reshape(-1, 4)
        g = np.array(self.polynomial.g_terms, dtype=np.int64).reshape(-1, 4)
        # every degree is compiled on its own; the first has the second's code, as fast
        degree = max(2, int(np.concatenate([f, g])[:, 2:].max()))
        x, y = self.sources.x[:, None], self.sources.y[:, None]
        ny, nx = self.detector.shape
        offsets, weights = self.detector.quadrature(*self.psf.core)
        return Optics(
            psf=profile_of(self.psf, self.sources.x, self.sources.y, self.detector.binning),
            x=self.sources.x,
            y=self.sources.y,
            f_powers=f[:, 2:].copy(),
            g_powers=g[:, 2:].copy(),
            f_object_powers=np.ascontiguousarray(x ** f[:, 0] * y ** f[:, 1]),
            g_object_powers=np.ascontiguousarray(x ** g[:, 0] * y ** g[:, 1]),
            offsets=offsets,
            weights=weights,
            step=float(self.detector.binning),
            ny=ny,
            nx=nx,
            support_radius=self.psf.support_radius(self.tolerance) / self.psf.sigma,
            ramp=self.detector.binning * np.arange(stride(nx), dtype=np.float64),
            degrees=Degrees(
                ab=(0,) * degree,
                q=(0,) * (2 * degree),
                d=(0,) * (2 * degree - 1) if self.conserve_flux else (),
            ),
            translates=None if np.concatenate([f, g])[:, 2:].any() else True,
        )

    def basis(self, nuisances: Sequence[str] = ()) -> Basis:
        """What the derivatives consist of: with respect to the monomials, then to the nuisances."""
        d, ones = self.polynomial, np.ones((len(self.sources), 1))
        constant = [(0, 0)] if "offset_x" in nuisances else []
        f = list(dict.fromkeys([t[2:] for t in d.f_terms] + constant))
        g = list(dict.fromkeys([t[2:] for t in d.g_terms] + constant))
        index = [f.index(t[2:]) for t in d.f_terms] + [len(f) + g.index(t[2:]) for t in d.g_terms]
        factors = [self._optics.f_object_powers, self._optics.g_object_powers]
        for name in nuisances:
            if name == "offset_x":  # the offsets enter a and b with a minus
                index.append(f.index((0, 0)))
            elif name == "offset_y":
                index.append(len(f) + g.index((0, 0)))
            else:
                index.append(len(f) + len(g) + ("flux_scale", "psf_sigma").index(name))
            factors.append(-ones if name.startswith("offset") else ones)
        return Basis(
            f=np.array(f, dtype=np.int64).reshape(-1, 2),
            g=np.array(g, dtype=np.int64).reshape(-1, 2),
            row=np.array(index, dtype=np.int64),
            factors=np.ascontiguousarray(np.concatenate(factors, axis=1)),
        )

    def expected_counts(self, theta: npt.ArrayLike, background: float = 0.0) -> Floats:
        """Expected counts of every pixel.

        Parameters
        ----------
        theta : array_like, shape (n_terms,), pixel^(1 - degree of the term)
            Distortion coefficients in the order of `distortion.names`.
        background : float, counts per pixel

        Returns
        -------
        ndarray, shape (ny, nx), counts per pixel

        Raises
        ------
        InputError
            If `theta` has another shape.
        """
        ny, nx = self.detector.shape
        if not isinstance(self.distortion, PolynomialDistortion):
            return self._every_pixel() + background
        out = np.full(ny * stride(nx), float(background))
        nuisances = SourceNuisances(1.0, 0.0, 0.0, self.psf.sigma, 0.0, 0.0)
        render(self._optics, self._monomial_coefficients(theta), nuisances, self.sources.flux, out)
        return out.reshape(ny, -1)[:, :nx]

    def _every_pixel(self) -> Floats:
        """The sources' image without compiled loops: every pixel and source, any distortion."""
        offsets, weights = self.detector.quadrature(*self.psf.core)
        u, v = (np.add.outer(centres, offsets) for centres in self.detector.pixel_centres())
        u, v = u[None, None], v[:, :, None, None]
        out = np.zeros(self.detector.shape)
        for x, y, flux in zip(self.sources.x, self.sources.y, self.sources.flux, strict=True):
            f, g = self.distortion.displacement((), u, v, x, y)
            kernel = flux * density_at(self.psf, u - x + f, v - y + g, (x, y))
            if self.conserve_flux:
                kernel *= np.abs(self.distortion.determinant((), u, v, x, y))
            out += np.einsum("jqip,q,p->ji", kernel, weights, weights, optimize=True)
        return out

    def jacobian(self, theta: npt.ArrayLike) -> Floats:
        """Derivatives of the expected counts with respect to theta.

        For an f-term with monomial B, F [p_a B |D| + p sign(D) (B_u (1 + g_v) - B_v g_u)]; for a
        g-term F [p_b B |D| + p sign(D) (B_v (1 + f_u) - B_u f_v)]; without flux conservation the
        first half alone.

        Parameters
        ----------
        theta : array_like, shape (n_terms,), pixel^(1 - degree of the term)

        Returns
        -------
        ndarray, shape (n_terms, ny, nx), counts per pixel per unit of the coefficient
        """
        ny, nx = self.detector.shape
        coefficients = self._monomial_coefficients(theta)
        out = np.zeros((coefficients.size, ny, stride(nx)))
        jacobian(self._optics, coefficients, self.psf.sigma, self.sources.flux, self.basis(), out)
        return self.polynomial.pull_back(out[:, :, :nx])

    def _monomial_coefficients(self, theta: npt.ArrayLike) -> Floats:
        coefficients = self.polynomial.monomial_coefficients(theta)
        if coefficients.ndim != 1:
            raise InputError(f"theta: got shape {np.shape(theta)}, expected one dimension")
        return np.ascontiguousarray(coefficients)

"""Simulated frames on which `benchmarks.rivals` compares methods, and the bound of their errors.

A frame has 100 catalogued stars on a jittered grid, box pixels, a background and Poisson noise. The
lens, the catalogue and the noise are drawn anew for each frame. The lens is a cubic polynomial in
(x, y) with an offset: 20 coefficients, which every method's own polynomial can describe. Of a grid
of dots it is OpenCV's, with a pose: 11 parameters, to first order those of `calibrateCamera`.

The bound is the Cramer-Rao bound of the field: the inverse of the Fisher information about lens,
offset and background, with the true PSF known and fluxes free, carried to the field's points.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

import bayesfred as bf
from bayesfred.imaging.psf import PSF

SIDE, SPACING, SHAPE = 10, 24.0, (257, 257)
MIDDLE = 0.5 * (np.array(SHAPE[::-1]) - 1.0)
HALF = 0.5 * (SIDE - 1) * SPACING  # of the field, pixel
TO_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))
BETA, ELLIPTICITY = 3.0, 0.2  # of the PSF with wings
COMPANION = 0.1  # flux of an uncatalogued one, of its star's

FOCAL_LENGTH = 400.0  # of the camera that sees dots, pixel
POINTS = np.stack(np.meshgrid(*2 * [np.linspace(-HALF, HALF, 15)]), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Case:
    """What is simulated.

    Attributes
    ----------
    name : str
    fwhm : float, pixel
    photons : float
        Of every star.
    background : float, counts per pixel
    blended : bool
        Half of the stars have a companion of the same flux at one FWHM.
    uncatalogued : bool
        Half of the stars have a companion of a tenth of the flux, which is in no catalogue.
    wings : bool
        The PSF is an elliptical Moffat function, which every method takes for a round Gaussian.
    flux_error : float
        Of the catalogue, relative.
    dots : bool
        A regular grid of dots, and OpenCV's lens.
    remedied : bool
        Remedies for a wrong model are compared, too.
    """

    name: str
    fwhm: float
    photons: float
    background: float = 5.0
    blended: bool = False
    uncatalogued: bool = False
    wings: bool = False
    flux_error: float = 0.0
    dots: bool = False
    remedied: bool = False

    @property
    def lens(self) -> bf.PolynomialDistortion:
        """Its terms."""
        return _camera() if self.dots else bf.PolynomialDistortion.polynomial(3)

    @property
    def sigma(self) -> float:
        """Of the Gaussian that the PSF is taken for, pixel."""
        return self.fwhm / TO_FWHM

    @property
    def psf(self) -> PSF:
        """The true one, without the pixel."""
        if not self.wings:
            return bf.GaussianPSF(self.sigma)
        a = np.arange(-120, 121) / 8.0
        squared = a**2 * (1.0 + ELLIPTICITY) + a[:, None] ** 2 / (1.0 + ELLIPTICITY)
        core = 4.0 * (2.0 ** (1.0 / BETA) - 1.0) / self.fwhm**2
        return bf.SampledPSF((1.0 + core * squared) ** -BETA, 8.0)


@dataclass(frozen=True)
class Frame:
    """A frame, and what is to be found.

    Attributes
    ----------
    case : Case
    counts : ndarray, shape (ny, nx)
    catalog : SourceCatalog
    places : ndarray, shape (n, 2), pixel
        Images of the catalogued sources, rounded; from the frame's middle, as below.
    field : ndarray, shape (m, 2), pixel
        True images of POINTS.
    variance : ndarray, shape (m, 2), pixel^2
        The bound there.
    """

    case: Case
    counts: np.ndarray
    catalog: bf.SourceCatalog
    places: np.ndarray
    field: np.ndarray
    variance: np.ndarray

    @property
    def alone(self) -> np.ndarray:
        """Which stars have no catalogued neighbour within three FWHM."""
        s = self.catalog
        apart = np.hypot(s.x[:, None] - s.x, s.y[:, None] - s.y)
        np.fill_diagonal(apart, np.inf)
        return np.asarray(apart.min(axis=1) > 3.0 * self.case.fwhm)


def forward_model(case: Case, sources: bf.SourceCatalog, psf: PSF) -> bf.ForwardModel:
    return bf.ForwardModel(bf.Detector(SHAPE, pixel="box"), sources, psf, case.lens)


def images(case: Case, parameters: Mapping[str, float], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Where object points are imaged, shape (n, 2), pixel."""
    theta = [parameters[name] for name in case.lens.names]
    offset = [parameters["offset_x"], parameters["offset_y"]]
    return np.stack(case.lens.image_position(theta, x, y, offset=offset), axis=1)


def jacobian(case: Case, names: Sequence[str], points: np.ndarray) -> np.ndarray:
    """Of the images of object points, shape (n, 2, d): they are linear in the lens's terms."""
    out = np.zeros((len(points), 2, len(names)))
    for k, unit in enumerate(np.eye(case.lens.n_terms)):
        out[:, :, k] = -np.stack(case.lens.displacement(unit, 0.0, 0.0, *points.T), axis=1)
    out[:, 0, names.index("offset_x")] = out[:, 1, names.index("offset_y")] = 1.0
    return out


def field_deviations(case: Case, names: Sequence[str], covariance: np.ndarray) -> np.ndarray:
    """Standard deviation of the images of POINTS."""
    along = jacobian(case, names, POINTS)
    return np.sqrt(np.einsum("ijk,kl,ijl->ij", along, covariance, along))


def _camera() -> bf.PolynomialDistortion:
    """OpenCV's five terms, and scale, rotation and two tilts of the target, to first order."""
    known = bf.PolynomialDistortion.radial_tangential(FOCAL_LENGTH)
    x, y, xx, xy, yy = ((*powers, 0, 0) for powers in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2)))
    f, g = (x, y, *known.f_terms), (x, y, *known.g_terms)
    basis = np.zeros((len(f) + len(g), known.n_terms + 4))
    basis[2 : len(f), : known.n_terms] = known.basis[: len(known.f_terms)]
    basis[len(f) + 2 :, : known.n_terms] = known.basis[len(known.f_terms) :]
    pose = {"scale": (x, y, 1.0), "turn": (y, x, -1.0), "tilt_x": (xx, xy, 1.0),
            "tilt_y": (xy, yy, 1.0)}  # fmt: skip
    for k, (in_f, in_g, sign) in enumerate(pose.values(), known.n_terms):
        unit = FOCAL_LENGTH ** (1.0 - sum(in_f))
        basis[f.index(in_f), k], basis[len(f) + g.index(in_g), k] = unit, sign * unit
    return bf.PolynomialDistortion(f, g, basis, [*known.names, *pose])


def _truth(case: Case, rng: np.random.Generator) -> dict[str, float]:
    """Lens, offset and background.

    Terms of the polynomial move the field's edge by 0.1 pixel, typically, those of the pose by 0.5.
    """
    lens = case.lens
    if case.dots:
        theta = rng.normal([-0.2, 0.05, 0.0, 0.0, 0.0], [0.03, 0.02, 0.0, 1e-3, 1e-3])
        theta, offset = np.append(theta, np.zeros(4)), np.zeros(2)
    else:
        degree = np.array([sum(powers) for powers in (*lens.f_terms, *lens.g_terms)])
        size = np.where(degree == 1, 0.5, 0.1)
        theta, offset = rng.normal(0.0, size) / HALF**degree, rng.uniform(-0.5, 0.5, 2)
    names = (*lens.names, "offset_x", "offset_y", "background")
    return dict(zip(names, [*theta, *offset, case.background], strict=True))


def _sources(case: Case, rng: np.random.Generator) -> tuple[bf.SourceCatalog, int]:
    """All sources, and how many of them, the first ones, are catalogued."""
    grid = (np.arange(SIDE) - 0.5 * (SIDE - 1)) * SPACING
    x, y = np.stack(np.meshgrid(grid, grid)).reshape(2, -1)
    jitter = rng.uniform(-2.0, 2.0, (2, x.size)) * (0.0 if case.dots else 1.0)
    x, y = np.stack([x, y]) + jitter + rng.uniform(-0.5, 0.5, (2, 1))
    flux, stars = np.full(x.size, case.photons), x.size
    if case.blended or case.uncatalogued:
        half, angle = np.arange(0, stars, 2), rng.uniform(0.0, 2.0 * np.pi, stars // 2)
        x = np.append(x, x[half] + case.fwhm * np.cos(angle))
        y = np.append(y, y[half] + case.fwhm * np.sin(angle))
        flux = np.append(flux, flux[half] * (COMPANION if case.uncatalogued else 1.0))
    return bf.SourceCatalog(x, y, flux), stars if case.uncatalogued else flux.size


def simulate(case: Case, seed: Sequence[int]) -> Frame:
    rng = np.random.default_rng(seed)
    truth = _truth(case, rng)
    sources, known = _sources(case, rng)

    def scene(sources: bf.SourceCatalog, counts: np.ndarray, flux: str) -> bf.Posterior:
        model = forward_model(case, sources, case.psf)
        return bf.Posterior(model, counts, nuisances=bf.Nuisances(flux=flux, offset=True))

    flat = np.full(SHAPE, case.background)
    whole = scene(sources, flat, "fixed")
    params = np.array([truth[name] for name in whole.parameter_names])
    counts = whole.simulate(params, rng)
    catalog = bf.SourceCatalog(sources.x[:known], sources.y[:known], sources.flux[:known])
    expected = scene(catalog, flat, "fixed").expected_counts(params)
    information = scene(catalog, expected, "free").fisher(params)
    bound = field_deviations(case, whole.parameter_names, np.linalg.inv(information)) ** 2
    listed = replace(catalog, flux=catalog.flux * rng.lognormal(0.0, case.flux_error, known))
    places = np.rint(images(case, truth, catalog.x, catalog.y))
    return Frame(case, counts, listed, places, images(case, truth, *POINTS.T), bound)

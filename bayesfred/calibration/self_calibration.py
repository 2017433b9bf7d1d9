"""An instrument calibrated by dithered frames of a field that is in no catalogue.

`self_calibrate` finds the sources of all frames, and fits their positions together with the
distortion and the frames' pointings: `model.dithered` has the posterior, `dither_start` finds where
to begin, and `degeneracies` says what such frames cannot see, which is fixed by convention and
reported. The errors are those of the Laplace approximation: the inverse of the information at the
maximum, positions and all, so that those of the distortion contain the positions' and the reverse.
`dither_tables` asks whether the posterior is normal, and judges frames and sources.
`dither_outliers` leaves out what does not fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.field import images_of
from bayesfred.calibration.calibration import Calibration
from bayesfred.calibration.degeneracies import Degeneracy, lost_directions
from bayesfred.calibration.dither_outliers import without_outliers
from bayesfred.calibration.dither_start import Dithers
from bayesfred.calibration.dither_tables import NORMAL, frame_table, newton_misses, source_summary
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.psf import PSF
from bayesfred.io.summary_table import Table, make_table
from bayesfred.model.dither_layout import POINTING
from bayesfred.model.dithered import DitheredPosterior
from bayesfred.model.noise import Noise, PoissonNoise
from bayesfred.model.parameters import Nuisances
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.optimize.fit_statistics import CONSISTENT

__all__ = ["SelfCalibration", "self_calibrate"]

DEGREE = 3
SHRUNK = 0.01  # share of a variance that the default prior may take
CALIBRATION_DRAWS = 1000


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """Distortion, pointings and a catalogue from dithered frames.

    Attributes
    ----------
    posterior : DitheredPosterior
        For `find_map`, `laplace` and `sample`.
    estimate : MapEstimate
        Its maximum. `covariance` is that of all parameters, the positions among them.
    degeneracies : tuple of Degeneracy
        What the frames cannot see. The coefficients named there are fixed: the others, and the
        catalogue, are those of an instrument with these values.
    not_normal : float
        By how much mean and variance of the displacement over the field, and of the pointings, may
        differ from the normal approximation's: standard deviations, at most. See `dither_tables`.
    frames : astropy.table.Table
        A row for each frame: `name`; `pointing_x`, `pointing_y` and `turn` with their `_sd`, fine
        pixel and degree, nan where they are given; number of `sources`; `deviance_z`, `pearson_z`:
        misfit in standard deviations.
    sources : astropy.table.Table
        A row for each source: `id`; `x`, `y`, fine pixel, their `_sd` and `correlation`; `flux` and
        `flux_sd`, counts, the mean of the frames; number of `frames` that show it; `chi2_z`, excess
        of the deviance of its pixels in all frames, `place_z`, excess of the scatter of its images
        about their places, both in standard deviations; `not_normal`, as above, of its position;
        `failed`: whether one of the two is too large.
    rejected : ndarray, shape (k, 2), fine pixel
        Where sources stood that did not fit, and were left out with their pixels: blends, what
        moves, what is no point.
    given : tuple of str
        Parameters whose prior was given.
    """

    posterior: DitheredPosterior
    estimate: MapEstimate
    degeneracies: tuple[Degeneracy, ...]
    not_normal: float
    frames: Table
    sources: Table
    rejected: Floats
    given: tuple[str, ...] = ()

    @property
    def fits_data(self) -> bool:
        """Whether all frames and sources agree with the model."""
        z = np.array([self.frames["deviance_z"], self.frames["pearson_z"]])
        return bool(np.all(np.abs(z) <= CONSISTENT) and not self.failed.any())

    @property
    def failed(self) -> Flags:
        """Sources that do not agree with the model, shape (n,)."""
        return np.array(self.sources["failed"], dtype=bool)

    @property
    def trustworthy(self) -> bool:
        """Whether the maximum is found, the model fits and the errors are those of a normal."""
        return bool(self.estimate.at_maximum and self.fits_data and self.not_normal < NORMAL)

    @cached_property
    def parameters(self) -> Table:
        """Coefficients: `name`, `value`, `sd`, and `status`: measured, fixed, or prior.

        The errors of the last are their priors', by more than 1 % of the variance. Only measured
        ones have an sd.
        """
        layout, names = self.posterior.layout, self.posterior.layout.coefficients
        free, covariance = layout.parts[0].theta, self.estimate.covariance
        default = self.posterior.prior_information(self.estimate.params).diagonal()
        default[[name in self.given for name in self.posterior.parameter_names]] = 0.0
        default[free.size :] = 0.0
        share = (covariance**2 @ default)[: free.size] / np.diag(covariance)[: free.size]
        sd, status = np.full(len(names), np.nan), np.full(len(names), "fixed", dtype="U8")
        status[free] = np.where(share > SHRUNK, "prior", "measured")
        sd[free] = np.sqrt(np.diag(covariance))[: free.size]
        sd[status != "measured"] = np.nan
        return make_table(
            {
                "name": list(names),
                "value": layout.theta(self.estimate.params),
                "sd": sd,
                "status": status,
            }
        )

    @cached_property
    def catalogue(self) -> SourceCatalog:
        """The sources' positions in the object plane and their fluxes, for a `Posterior`.

        The positions are not exact: `positions_covariance` has their errors.
        """
        x, y, flux = (np.array(self.sources[name]) for name in ("x", "y", "flux"))
        return SourceCatalog(x, y, flux)

    @cached_property
    def positions_covariance(self) -> Floats:
        """Covariance of every source's x and y, shape (n, 2, 2), fine pixel^2."""
        first, covariance = self.posterior.layout.n_dense, self.estimate.covariance
        each = first + 2 * np.arange(self.posterior.layout.n_sources)[:, None] + np.arange(2)
        return np.asarray(covariance[each[:, :, None], each[:, None, :]])

    @property
    def message(self) -> str:
        """What was found: misfit first, then what the frames cannot see, then the errors."""
        return " ".join([self._said_of_fit, self._said_of_degeneracies, self._said_of_errors])

    def calibration(self, *, seed: int = 0, title: str = "") -> Calibration:
        """The calibration of the instrument, without the sources.

        Parameters
        ----------
        seed : int
            Of its draws.
        title : str

        Returns
        -------
        Calibration
            Its object plane is that of the frames at rest: an object of the catalogue is at its
            position, turned and displaced by the frame's pointing. Fixed coefficients have no
            errors in it.
        """
        posterior, layout = self.posterior, self.posterior.layout
        p = layout.parts[0].theta.size
        random = np.random.default_rng(seed)
        covariance = self.estimate.covariance[:p, :p]
        free = random.multivariate_normal(
            self.estimate.params[:p], covariance, CALIBRATION_DRAWS, method="cholesky"
        )
        draws = np.zeros((CALIBRATION_DRAWS, len(layout.coefficients) + 2))
        draws[:, layout.parts[0].theta] = free
        for name, value in posterior.fixed.items():
            draws[:, layout.coefficients.index(name)] = value
        params, model = self.estimate.params, posterior.reference.model
        images = [
            images_of(posterior.frame_posterior(name, params), layout.frame_params(name, params))
            for name in posterior.frames
        ]
        named = dict(zip(posterior.parameter_names, params, strict=True))
        widths = [named.get(f"{name}.psf_sigma", model.psf.sigma) for name in posterior.frames]
        return Calibration(
            model.polynomial, draws, model.detector, model.psf, float(np.mean(widths)),
            np.concatenate(images), None, title, self.message, self.trustworthy,
        )  # fmt: skip

    @property
    def _said_of_fit(self) -> str:
        if not self.estimate.at_maximum:
            return f"Not trustworthy: {self.estimate.message}."
        number = len(self.frames)
        z = np.array([self.frames["deviance_z"], self.frames["pearson_z"]])
        largest = np.unravel_index(np.argmax(np.abs(z)), z.shape)
        name, value = self.frames["name"][largest[1]], z[largest]
        how = (
            f"the {'deviance' if largest[0] == 0 else 'Pearson statistic'} of {name} is at "
            f"{value:+.1f} standard deviations from its expectation, the farthest"
        )
        bad = int(np.sum(np.abs(z).max(axis=0) > CONSISTENT))
        said = f"{bad} of {number} frames do not fit" if bad else f"All {number} frames fit"
        failed, gone = np.flatnonzero(self.failed), len(self.rejected)
        if gone:
            said += f", {gone} source{'s' if gone > 1 else ''} left out that did not fit"
        if failed.size:
            some = ", ".join(map(str, failed[:5])) + (", ..." if failed.size > 5 else "")
            said += f", {failed.size} of {len(self.sources)} sources do not: {some}"
        return f"{said} ({how})."

    @property
    def _said_of_degeneracies(self) -> str:
        sentences = []
        for fixed, words in (
            (True, "Not seen by these frames, fixed by convention"),
            (False, "Hardly seen, left to the priors, which the errors come from"),
        ):
            parts = [
                f"{each.what} ({', '.join(each.parameters)})"
                + (f", which would need {each.remedy}" if each.remedy else "")
                for each in self.degeneracies
                if each.fixed == fixed
            ]
            if parts:
                sentences.append(f"{words}: {'; '.join(parts)}.")
        return " ".join(sentences)

    @property
    def _said_of_errors(self) -> str:
        trace = np.trace(self.positions_covariance, axis1=1, axis2=2)
        error = float(np.sqrt(0.5 * np.median(trace)))
        normal = (
            "The posterior is normal"
            if self.not_normal < NORMAL
            else "The posterior is not normal, so its errors are not to be trusted: sample it"
        )
        return (
            f"{len(trace)} sources, positions known to {error:.2g} px (median). {normal} "
            f"(mean and variance within {self.not_normal:.1g} standard deviations)."
        )


def self_calibrate(
    frames: Mapping[str, npt.ArrayLike],
    detector: Detector,
    psf: PSF,
    distortion: PolynomialDistortion | None = None,
    *,
    noise: Noise = PoissonNoise(),
    nuisances: Nuisances = Nuisances(flux="free"),
    pointings: Mapping[str, Sequence[float]] | None = None,
    pointing_sd: float | None = None,
    turns: Mapping[str, float] | None = None,
    prior: Mapping[str, Any] | None = None,
) -> SelfCalibration:
    """Calibrate an instrument by dithered frames of a field that is in no catalogue.

    Parameters
    ----------
    frames : mapping of str to array_like, shape (ny, nx), counts
        By name, at least two; what `Posterior` takes as counts, masked arrays among them.
    detector : Detector
    psf : PSF
    distortion : PolynomialDistortion, optional
        By default the polynomials of degree 3 in x and y, linear terms among them.
    noise : Noise
    nuisances : Nuisances
        Every frame's own. Fluxes are free.
    pointings : mapping of str to (float, float), fine pixel, optional
        By how much the field is displaced in each frame: where an object at the origin of the
        plane stands. By default found from the frames. Those of the first frame, by default 0,
        define the plane's origin.
    pointing_sd : float, optional, fine pixel
        Standard deviation of their errors, independent from frame to frame: then the pointings
        tell of the scale. Without it they are only where the search begins.
    turns : mapping of str to float, degree, optional
        By which angle the field is turned in each frame, from x to y, to within about a degree.
        That of the first frame defines the plane's axes, those of the others are fitted. By
        default no frame is turned.
    prior : mapping of str to frozen scipy.stats distribution, optional
        What is known of coefficients, and of frames' own parameters by names such as
        `a.background`.

    Returns
    -------
    SelfCalibration

    Raises
    ------
    InputError
        If there are fewer than two frames, one does not fit the detector, fluxes are not free, or
        the frames cannot be placed.

    Notes
    -----
    The maximum of n sources takes the inverse of a matrix of 2 n rows a few times: up to some
    thousand sources that is less than the likelihoods.

    References
    ----------
    I. R. King, J. Anderson (2003), PASP 115, 113: self-calibration of a camera's distortion.
    R. Holmes, D. W. Hogg, H.-W. Rix (2012), PASP 124, 1219: which dithers tell of an instrument.

    Examples
    --------
    >>> import bayesfred as bf
    >>> sky = np.random.default_rng(1).uniform(-60.0, 60.0, (40, 2))
    >>> lens = bf.PolynomialDistortion.polynomial(2)
    >>> frames = {}
    >>> for k, (x, y) in enumerate([(0.0, 0.0), (15.0, 3.0), (-4.0, 12.0)]):
    ...     field = bf.SourceCatalog(sky[:, 0] + x, sky[:, 1] + y, np.full(40, 1e4))
    ...     model = bf.ForwardModel(bf.Detector((101, 101)), field, bf.GaussianPSF(1.5), lens)
    ...     truth = [0.0, 0.0, 4e-4, 0.0, 0.0, 0.0, 0.0, 0.0, 4e-4, 0.0]
    ...     frames["abc"[k]] = bf.simulate(model, truth, 5.0, seed=k)
    >>> found = bf.self_calibrate(frames, model.detector, model.psf, lens)
    >>> found.degeneracies[1].parameters
    ('f_x', 'f_y', 'g_x', 'g_y')
    >>> len(found.catalogue) >= 20
    True
    """
    if nuisances.flux != "free":
        raise InputError(
            f"nuisances: flux: got {nuisances.flux!r}, expected 'free': no catalogue has the fluxes"
        )
    field = PolynomialDistortion.polynomial(DEGREE) if distortion is None else distortion
    dithers = Dithers.of(
        frames, (detector, psf, field), (noise, nuisances, prior or {}),
        (pointings, pointing_sd, turns),
    )  # fmt: skip
    with one_blas_thread():  # idle BLAS threads spin and take half the cores
        posterior, start, links = dithers.posterior()
        found = [_convention(posterior)]
        unseen, _ = lost_directions(posterior, start, dithers.prior)
        if unseen is not None:
            found.append(unseen)
            fixed = dict.fromkeys(unseen.parameters, 0.0)
            posterior, start, _ = dithers.posterior(links, fixed)
        posterior, start, rejected = without_outliers(posterior, start)
        estimate = find_map(posterior, start)
        found += [
            each for each in lost_directions(posterior, estimate.params, dithers.prior) if each
        ]
        at = estimate.params, estimate.covariance
        not_normal, misses = newton_misses(posterior, *at)
        tables = frame_table(posterior, *at), source_summary(posterior, *at, misses)
    return SelfCalibration(
        posterior, estimate, tuple(found), not_normal, *tables, rejected, tuple(dithers.prior)
    )


def _convention(posterior: DitheredPosterior) -> Degeneracy:
    """What no frames tell: where the object plane has its origin and its axes."""
    name, none = next(iter(posterior.frames)), np.zeros((0, len(posterior.layout.coefficients)))
    names = tuple(f"{name}.{each}" for each in POINTING[: 3 if posterior.turned else 2])
    what = "a common shift and turn of all sources" if posterior.turned else "a common shift"
    return Degeneracy(what, names, True, none, "")

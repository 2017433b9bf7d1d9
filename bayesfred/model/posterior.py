"""The posterior of a field distortion: prior times likelihood of a frame, of a parameter vector.

`parameters` says what the parameters are, `priors` and `likelihood` hold the two factors.
`optimize.find_map` finds the maximum, `sampling.sampler` draws.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.errors import InputError
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import PSF, has_pixel
from bayesfred.io.arrays import frame_given
from bayesfred.io.serialize import serializable
from bayesfred.model import priors
from bayesfred.model.displacement_errors import DisplacementErrors
from bayesfred.model.extrapolation import Extrapolation
from bayesfred.model.frame_density import FrameDensity
from bayesfred.model.likelihood import FrameLikelihood
from bayesfred.model.near_mean import Around
from bayesfred.model.noise import Noise, PoissonNoise
from bayesfred.model.observed import displacing_parameters, observed_information
from bayesfred.model.parameters import Nuisances, Parameter, parameter_table
from bayesfred.model.pixels import usable_pixels
from bayesfred.model.psf_errors import PsfErrors


@serializable("posterior")
@dataclass(frozen=True, eq=False, init=False)
class Posterior(FrameDensity):
    """Posterior of distortion, background and nuisances given a frame.

    Parameters
    ----------
    model : ForwardModel
    counts : array_like, MaskedArray, Quantity, NDData or CCDData, shape (ny, nx), counts
        Masked pixels are not used. A unit has to be electrons, photons or counts; uncertainties
        have to be those of the noise model. A `numpy.memmap` of whole numbers or float64 is not
        copied: its file must stay as it is.
    prior : mapping of str to frozen scipy.stats distribution, optional
        By parameter name; the others get the default of the table of parameters. Parameters are
        independent a priori. A distortion that leaves a source without an image, or folds the frame
        (D <= 0) within two of the PSF's widths of one, has probability zero.
    noise : Noise
        `PoissonNoise`, `FlatFieldNoise`, `GaussianNoise`, `BackgroundNoise` or a model of your own.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is to be used.
    nuisances : Nuisances
    extrapolation : FluxExtrapolation, ShiftExtrapolation or Around, optional
        What `near` knows: where free fluxes have their maximum around some parameters; or with
        fixed fluxes and read noise, these parameters.
    valid : array_like of bool, shape (ny, nx), optional
        True where a pixel may be used when the footprint moves; by default `mask`.
    psf_errors : PsfErrors, optional
        What the errors of a measured PSF add to the parameters': `marginalize_psf` finds it.
        `log_prob` is that with the PSF fixed, but for its volume's word on the model error;
        `MapEstimate.covariance` and `Chain.draws` have them.
    displacement_errors : DisplacementErrors, optional
        What displacements that neighbouring sources have in common add: `marginalize_displacements`
        finds it. They are as little in `log_prob`.

    Attributes
    ----------
    counts : ndarray, shape (ny, nx), counts; 0 where not finite
        Whole numbers where these are mapped from a file, else float64.
    mask : ndarray of bool, shape (ny, nx)
        Pixels in the likelihood: those asked for, within the footprint.

    Raises
    ------
    InputError
        If the frame does not fit the detector, is in another unit or has other uncertainties, holds
        values that no noise model explains, every pixel is masked, no source lies in the frame, or
        a prior is unusable; if the extrapolation is of another model, or added errors are of
        other parameters.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> posterior.parameter_names
    ('f_ux', 'background')
    """

    model: ForwardModel
    counts: Floats
    prior: Mapping[str, Any]
    noise: Noise
    mask: Flags
    nuisances: Nuisances
    extrapolation: Extrapolation | Around | None = field(metadata={"stored": False})
    valid: Flags = field(metadata={"since": 9})
    psf_errors: PsfErrors | None = field(metadata={"since": 6})
    displacement_errors: DisplacementErrors | None = field(metadata={"since": 10})

    def __init__(
        self,
        model: ForwardModel,
        counts: npt.ArrayLike,
        *,
        prior: Mapping[str, Any] | None = None,
        noise: Noise = PoissonNoise(),
        mask: npt.ArrayLike | None = None,
        nuisances: Nuisances = Nuisances(),
        extrapolation: Extrapolation | Around | None = None,
        valid: npt.ArrayLike | None = None,
        psf_errors: PsfErrors | None = None,
        displacement_errors: DisplacementErrors | None = None,
    ) -> None:
        frame, mask = frame_given(counts, mask, getattr(noise, "variance", None))
        used = usable_pixels(model, frame, mask, noise, nuisances)
        finite = np.isfinite(frame)
        if valid is None:
            valid = finite & (True if mask is None else mask)
        valid = used if np.array_equal(valid, used) else np.array(valid, dtype=bool)
        if isinstance(extrapolation, Extrapolation) and extrapolation.model is not model:
            raise InputError(
                "extrapolation: got that of another model, expected this one's: leave it out"
            )
        if not finite.all():
            frame = np.where(finite, frame, 0.0)
        self._set_fields(
            model, frame, {}, noise, used, nuisances,
            extrapolation, valid, psf_errors, displacement_errors,
        )  # fmt: skip
        object.__setattr__(self, "prior", priors.with_defaults(prior or {}, self.parameters))
        for errors in (psf_errors, displacement_errors):
            if errors is not None:
                errors.require_names(self.parameter_names)
        if isinstance(extrapolation, Around) and extrapolation.params.size != self.n_parameters:
            raise InputError(
                f"extrapolation: got one about {extrapolation.params.size} parameters, expected "
                f"{self.n_parameters}: leave it out"
            )

    @cached_property
    def likelihood(self) -> FrameLikelihood:
        """The likelihood of the frame."""
        width = self.prior.get("psf_sigma")
        narrowest = None if width is None else float(width.ppf(1e-6))
        occam = None if self.psf_errors is None else self.psf_errors.occam
        return FrameLikelihood(
            self.model, self.counts, self.noise, self.mask, self.nuisances, self.parameters,
            narrowest, self.extrapolation, occam,
        )  # fmt: skip

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The table of parameters, in the order of every parameter vector."""
        return parameter_table(self.model, self.nuisances, self.counts[self.mask])

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of every parameter vector."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """Scale parameters, on which proposals nest the Laplace approximation."""
        return ("position_scatter",) if self.nuisances.position_scatter else ()

    def start(self) -> Floats:
        """Parameters to begin a search from: no distortion, the frame's median as background."""
        return np.array([parameter.start for parameter in self.parameters])

    def log_prob(self, params: npt.ArrayLike) -> Any:
        """Log-posterior density up to the evidence; the likelihood is normalised.

        Parameters
        ----------
        params : array_like, shape (d,) or (n, d)

        Returns
        -------
        float or ndarray, shape (n,)
            -inf outside the prior's support; NaN and +inf, where the arithmetic gives them, are no
            densities.

        Raises
        ------
        InputError
            If a parameter vector has another length.
        """
        vectors = self._vectors(params)
        prior = self.log_prior(vectors)
        out = self.likelihood.log_likelihood(vectors, prior > -np.inf)
        out = np.where(out > -np.inf, out + prior, out)
        out[np.isnan(prior)] = np.nan
        return float(out[0]) if np.ndim(params) == 1 else out

    def gradient(self, params: npt.ArrayLike) -> Floats:
        """Exact gradient of `log_prob`, shape (d,); NaN outside the prior's support."""
        slope = self.prior_gradient(params)
        if np.isnan(slope).any():
            return slope
        return self.likelihood.gradient(self._vector(params)) + slope

    def fisher(self, params: npt.ArrayLike) -> Floats:
        """Fisher information of the frame about the parameters, free fluxes profiled out.

        Returns
        -------
        ndarray, shape (d, d); NaN outside the prior's support
            Without the prior.
        """
        vector = self._vector(params)
        if not np.isfinite(self.log_prior(vector)[0]):
            return np.full((vector.size, vector.size), np.nan)
        return self.likelihood.fisher(vector)

    def observed_information(
        self, params: npt.ArrayLike, covariance: Floats
    ) -> tuple[Ints, Floats]:
        """The parameters that displace images, and the observed information about these.

        Parameters
        ----------
        params : array_like, shape (d,)
        covariance : ndarray, shape (d, d)
            How far around.

        Returns
        -------
        which : ndarray of int, shape (k,)
            None where f or g depends on (u, v) or the pointing is no parameter.
        information : ndarray, shape (k, k)
            The others known, with the curvature of the prior; NaN where there is no density.
        """
        which = displacing_parameters(self.likelihood)
        if not which.size:
            return super().observed_information(params, covariance)
        block = np.ix_(which, which)
        found = observed_information(self.likelihood, self._vector(params), covariance[block])
        return which, found + self.prior_information(params)[block]

    def near(self, params: Floats, covariance: Floats) -> "Posterior":
        """The same posterior, with a faster `log_prob` around `params`.

        Free fluxes: it extrapolates the most likely ones from those at `params`. Where that fails
        it looks for them as usual; values differ by rounding and at most 5e-5, by some 1e-6 within
        a few standard deviations.

        Scattered positions: it extrapolates fluxes and shifts. It looks for their maximum from
        there, until the rest of the way is known well enough: values differ by some 1e-6 for every
        source, up to 3e-5 for faint ones. Beyond 5 + sqrt(d) standard deviations it looks for them
        as usual.

        Otherwise, also with fixed fluxes and a model error, it is the posterior itself.

        Parameters
        ----------
        params : ndarray, shape (d,)
        covariance : ndarray, shape (d, d)
            How far around.

        Returns
        -------
        Posterior

        Raises
        ------
        InputError
            If there are more or fewer parameters than the posterior has.
        """
        close = self.likelihood.near(self._vector(params), covariance)
        if close is self.likelihood:
            return self
        found = replace(self, extrapolation=close.extrapolation)
        vars(found)["likelihood"] = close  # with what is made of the frame
        return found

    def with_psf(self, psf: PSF) -> "Posterior":
        """The same posterior with another PSF, and without errors that are added.

        A PSF that has the pixel's response in it is sampled at the pixels' centres, and its width
        is no parameter.

        Parameters
        ----------
        psf : PSF

        Returns
        -------
        Posterior
        """
        detector, nuisances, prior = self.model.detector, self.nuisances, dict(self.prior)
        if has_pixel(psf):
            detector = replace(detector, pixel="impulse")
            nuisances = replace(nuisances, psf_sigma=False)
            prior.pop("psf_sigma", None)
        model = replace(self.model, psf=psf, detector=detector)
        return replace(
            self, model=model, prior=prior, nuisances=nuisances, extrapolation=None,
            psf_errors=None, displacement_errors=None,
        )  # fmt: skip

    def simulate(
        self,
        params: npt.ArrayLike,
        rng: np.random.Generator,
        fluxes: Floats | None = None,
    ) -> Floats | None:
        """Draw a frame given the parameters; see `FrameLikelihood.simulate`."""
        return self.likelihood.simulate(self._vector(params), rng, fluxes)

    def expected_counts(self, params: npt.ArrayLike) -> Floats:
        """Expected counts of every pixel, free fluxes at their most likely values.

        Returns
        -------
        ndarray, shape (ny, nx), counts per pixel
            NaN where a map folds.
        """
        return self.likelihood.expected_counts(self._vector(params))

    def sigma(self, params: npt.ArrayLike) -> Floats:
        """Standard deviation of every pixel's counts under the noise model, shape (ny, nx)."""
        level = self._vector(params)[self.parameter_names.index("background")]
        noise = self.noise_at(params).pixelwise
        return np.sqrt(noise.counts_variance(self.expected_counts(params), level))

    def noise_at(self, params: npt.ArrayLike) -> Noise:
        """The noise of the counts, the model error included, given the parameters."""
        return self.likelihood.noise_at(self._vector(params))

    def fluxes(self, params: npt.ArrayLike) -> Floats:
        """Flux of every source, counts: the catalogue's, scaled, or the most likely ones.

        Free fluxes are those at which the density of their logarithms is highest.
        """
        return self.likelihood.fluxes(self._vector(params))

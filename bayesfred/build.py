"""From the settings of a run file to the objects that they describe."""

from pathlib import Path
from typing import Any

import numpy as np

from bayesfred import settings
from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError, printable
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import PSF, GaussianPSF, MoffatPSF, SampledPSF
from bayesfred.io import files
from bayesfred.model import priors
from bayesfred.model.noise import BackgroundNoise, PoissonNoise, simulate
from bayesfred.model.posterior import Nuisances, Posterior

# Share of the frame's half-width by which images may stand away from their sources: three standard
# deviations of a term's default prior. Sources whose light is farther from the frame than that are
# left out.
STRAY = 0.3


def catalogue(
    run: settings.RunSettings, run_file: Path, shape: tuple[int, int], psf: PSF
) -> tuple[SourceCatalog, str]:
    """The catalogue's sources whose light can reach the frame, and a line that counts them.

    A source is at the edge if the frame's border is within three widths of the PSF, or between it
    and the frame; and outside if no light reaches the frame from an image that stands `STRAY`
    nearer. If all are outside, all are kept: the posterior says so.
    """
    c, path = run.catalogue, settings.resolve(run.catalogue.path, run_file, must_exist=True)
    record = files.read_catalogue(
        path, x=c.x, y=c.y, flux=c.flux, magnitude=c.magnitude, zero_point=c.zero_point
    )
    half = 0.5 * run.detector.binning * np.array(shape)[::-1, None]
    beyond = np.abs([record.x, record.y]) - half  # pixels, negative inside
    outside = (beyond > psf.support_radius(run.model.tolerance) + STRAY * half).any(axis=0)
    kept = ~outside if not outside.all() else outside
    at_edge = kept & (beyond > -3.0 * psf.sigma).any(axis=0)
    numbers = (
        f"{len(record.x)} sources, {at_edge.sum()} at the frame's edge, {(~kept).sum()} "
        "outside left out"
    )
    return SourceCatalog(
        record.x[kept], record.y[kept], record.flux[kept]
    ), f"{printable(path.name)}: {numbers}"


def reference_psf(run: settings.RunSettings, run_file: Path) -> PSF:
    """The PSF of [psf]."""
    p = run.psf
    if p.sigma is not None:
        return GaussianPSF(p.sigma)
    if p.fwhm is not None and p.beta is not None:
        return MoffatPSF(p.fwhm, p.beta)
    path = settings.resolve(p.path or "", run_file, must_exist=True)
    image = files.read_frame(path, gain=1.0)
    if image.n_masked:
        raise InputError(
            f"{path}: got {image.n_masked} pixels that are not finite, expected samples of a PSF: "
            "fill them first"
        )
    try:
        return SampledPSF(image.counts, p.oversampling or 0.0)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def forward_model(
    run: settings.RunSettings, shape: tuple[int, int], sources: SourceCatalog, psf: PSF
) -> ForwardModel:
    """The forward model of [detector], [distortion] and [model]."""
    d = run.distortion
    if d.terms is None:
        distortion = PolynomialDistortion(d.f_terms or (), d.g_terms or ())
    elif d.degree is not None:
        distortion = PolynomialDistortion.full_polynomial(d.degree)
    else:
        distortion = getattr(PolynomialDistortion, d.terms)()
    detector = Detector(shape, binning=run.detector.binning, pixel=run.detector.pixel)
    m = run.model
    return ForwardModel(
        detector, sources, psf, distortion, conserve_flux=m.conserve_flux, tolerance=m.tolerance
    )


def noise_model(run: settings.RunSettings) -> PoissonNoise | BackgroundNoise:
    """The noise of [noise]."""
    return (
        BackgroundNoise() if run.noise.kind == "background" else PoissonNoise(run.noise.read_noise)
    )


def priors_given(run: settings.RunSettings) -> dict[str, Any]:
    """The priors of [prior]."""
    return {name: priors.make(name, p.distribution, p.keywords) for name, p in run.prior.items()}


def posterior_given(
    run: settings.RunSettings,
    model: ForwardModel,
    counts: Floats,
    mask: Flags | None,
) -> Posterior:
    """The posterior of a frame with the nuisances and priors of the run file."""
    n = run.nuisances
    nuisances = Nuisances(
        n.flux, n.offset, n.psf_sigma, n.background_order, n.footprint, n.position_scatter
    )
    return Posterior(
        model,
        counts,
        prior=priors_given(run),
        noise=noise_model(run),
        mask=mask,
        nuisances=nuisances,
    )


def simulated(run: settings.RunSettings, run_file: Path, seed: int) -> tuple[Posterior, Floats]:
    """A simulated frame's posterior and the true parameters."""
    s = run.simulation
    assert s is not None, "checked by the callers"
    files.require_memory(f"{run_file}: simulation.shape", s.shape)
    psf = reference_psf(run, run_file)
    if s.grid:
        sources = SourceCatalog.grid(s.grid.side, s.grid.spacing, s.grid.flux)
    else:
        sources, _ = catalogue(run, run_file, s.shape, psf)
    model = forward_model(run, s.shape, sources, psf)
    unknown = sorted(set(s.theta) - set(model.distortion.names))
    if unknown:
        raise InputError(
            f"{run_file}: simulation.theta: got {', '.join(unknown)}, expected names among "
            f"{', '.join(model.distortion.names)}"
        )
    theta = np.array([s.theta.get(name, 0.0) for name in model.distortion.names])
    noise = noise_model(run)
    counts = simulate(model, theta, s.background, seed=seed, noise=noise)
    posterior = posterior_given(run, model, counts, None)
    known = {**dict(zip(model.distortion.names, theta, strict=True)), "background": s.background}
    known |= {"flux_scale": 1.0, "psf_sigma": model.psf.sigma}
    truth = np.array([known.get(name, 0.0) for name in posterior.parameter_names])
    if not np.all(np.isfinite(posterior.expected_counts(truth))):
        raise InputError(
            f"{run_file}: simulation.theta: got a distortion that folds a source's image, "
            "expected a weaker one"
        )
    return posterior, truth

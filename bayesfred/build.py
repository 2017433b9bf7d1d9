"""From the settings of a run file to the objects that they describe."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from bayesfred import settings
from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import PSF, MeasuredPSF, PSFFile, PSFToMeasure, has_pixel
from bayesfred.io.frames import read_frame, require_memory
from bayesfred.io.paths import resolve
from bayesfred.model import priors
from bayesfred.model.noise import Noise, PoissonNoise, simulate
from bayesfred.model.posterior import Posterior
from bayesfred.settings.joint import JointRun
from bayesfred.settings.simulation import SimulationSettings
from bayesfred.sources import find_sources

SECTIONS = ("frame", "catalogue", "psf", "noise")  # that may name a file


def inputs(
    run: settings.RunSettings | JointRun, run_file: Path, sections: Sequence[str] = SECTIONS
) -> list[Path]:
    """The run file, and the files that its sections name, whether they are there or not."""
    runs = run.frames.values() if isinstance(run, JointRun) else (run,)
    named = (getattr(getattr(own, part), "path", None) for own in runs for part in sections)
    files = dict.fromkeys(path for path in named if path)  # frames may have one catalogue
    return [run_file, *(resolve(path, run_file) for path in files)]


@contextmanager
def naming(run_file: Path) -> Iterator[None]:
    """Begin the line of an error with the run file that describes what was refused.

    Parameters
    ----------
    run_file : Path

    Raises
    ------
    InputError
        In place of the one raised within.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{run_file}: {error}") from None


def reference_psf(run: settings.RunSettings, run_file: Path) -> PSF:
    """The PSF of [psf]."""
    if run.psf.made is PSFFile:
        return MeasuredPSF.read(resolve(run.psf.path, run_file, must_exist=True))
    arrays = list(run.psf.given)
    if not arrays:
        return cast(PSF, run.psf.make())
    path = resolve(run.psf.path, run_file, must_exist=True)
    image = read_frame(path, gain=1.0, pedestal=0.0, saturation=math.inf)
    if image.n_masked:
        raise InputError(
            f"{path}: got {image.n_masked} pixels that are not finite, expected samples of a PSF: "
            "fill them first"
        )
    try:
        return cast(PSF, run.psf.make(**dict.fromkeys(arrays, image.counts)))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def forward_model(
    run: settings.RunSettings, shape: tuple[int, int], sources: SourceCatalog, psf: PSF
) -> ForwardModel:
    """The forward model of [detector], [distortion] and [model]."""
    detector: Detector = run.detector.make(shape=shape)
    if has_pixel(psf):
        detector = replace(detector, pixel="impulse")
    distortion = run.distortion.make(radius=0.5 * math.hypot(*detector.fine_shape))
    m = run.model
    return ForwardModel(
        detector, sources, psf, distortion, conserve_flux=m.conserve_flux, tolerance=m.tolerance
    )


def priors_given(run: settings.RunSettings | JointRun) -> dict[str, Any]:
    """The priors of [prior]. Of several frames: the priors that no frame has alone."""
    return {name: priors.make(name, p.distribution, p.keywords) for name, p in run.prior.items()}


def noise_given(run: settings.RunSettings, read_noise: float | None) -> tuple[Noise, str]:
    """The noise of [noise], and a line of what becomes of the read noise in a frame's header.

    Where [noise] does not say a read noise, it is the header's.
    """
    noise: Noise = run.noise.make()
    if not read_noise or getattr(noise, "read_noise", None) == read_noise:
        return noise, ""
    if isinstance(noise, PoissonNoise) and "read_noise" not in run.noise.model_fields_set:
        return PoissonNoise(read_noise), f"read noise: {read_noise:g} e-, from the header"
    return noise, f"read noise: {read_noise:g} e- of the header not used, as [noise] says the noise"


def posterior_given(
    run: settings.RunSettings,
    model: ForwardModel,
    counts: Floats,
    mask: Flags | None,
    noise: Noise,
) -> Posterior:
    """The posterior of a frame with the nuisances and priors of the run file."""
    nuisances, prior = run.nuisances.make(), priors_given(run)
    if isinstance(model.psf, PSFToMeasure):  # its width is looked for first, its error last
        nuisances = replace(nuisances, psf_sigma=True, model_error=False)
        prior.pop("model_error", None)
    return Posterior(
        model,
        counts,
        prior=prior,
        noise=noise,
        mask=mask,
        nuisances=nuisances,
    )


def simulation(run: settings.RunSettings, run_file: Path) -> SimulationSettings:
    """The section that describes a frame to simulate; an InputError where there is none."""
    if run.simulation is None:
        raise InputError(
            f"{run_file}: simulation: no such section, expected shape, theta and background: see "
            "bayesfred fit --help"
        )
    return run.simulation


def simulated(run: settings.RunSettings, run_file: Path, seed: int) -> tuple[Posterior, Floats]:
    """A simulated frame's posterior and the true parameters."""
    s = simulation(run, run_file)
    require_memory(f"{run_file}: simulation.shape", s.shape)
    psf = reference_psf(run, run_file)
    if s.grid:
        sources = SourceCatalog.grid(s.grid.side, s.grid.spacing, s.grid.flux)
    else:
        sources = find_sources(run, run_file, s.shape, psf)[0]
    with naming(run_file):
        model = forward_model(run, s.shape, sources, psf)
    unknown = sorted(set(s.theta) - set(model.distortion.names))
    if unknown:
        raise InputError(
            f"{run_file}: simulation.theta: got {', '.join(unknown)}, expected names among "
            f"{', '.join(model.distortion.names)}"
        )
    theta = np.array([s.theta.get(name, 0.0) for name in model.distortion.names])
    noise = run.noise.make()
    with naming(run_file):
        counts = simulate(model, theta, s.background, seed=seed, noise=noise)
        posterior = posterior_given(run, model, counts, None, noise)
    known = {**dict(zip(model.distortion.names, theta, strict=True)), "background": s.background}
    known |= {"flux_scale": 1.0, "psf_sigma": model.psf.sigma}
    truth = np.array([known.get(name, 0.0) for name in posterior.parameter_names])
    if not np.all(np.isfinite(posterior.expected_counts(truth))):
        raise InputError(
            f"{run_file}: simulation.theta: got a distortion that folds a source's image, "
            "expected a weaker one"
        )
    return posterior, truth

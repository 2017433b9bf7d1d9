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
from bayesfred.io.pixel_maps import PixelMaps, read_maps
from bayesfred.model import priors
from bayesfred.model.noise import CorrelatedNoise, FlatFieldNoise, Noise, PoissonNoise, simulate
from bayesfred.model.posterior import Posterior
from bayesfred.settings.joint import JointRun
from bayesfred.settings.simulation import SimulationSettings
from bayesfred.sources import find_sources

SECTIONS = ("frame", "catalogue", "psf", "noise")  # that may name a file


def inputs(
    run: settings.RunSettings | JointRun, run_file: Path, sections: Sequence[str] = SECTIONS
) -> list[Path]:
    """The run file, and the files that its sections name, whether they are there or not."""
    runs = tuple(run.frames.values()) if isinstance(run, JointRun) else (run,)
    named = (getattr(getattr(own, part), "path", None) for own in runs for part in sections)
    maps = (path for own in runs for path in own.frame.maps.values())
    files = dict.fromkeys(path for path in (*named, *maps) if path)  # frames may share them
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


def maps_given(run: settings.RunSettings, run_file: Path) -> PixelMaps:
    """The maps of pixels that [frame] names."""
    if run.frame.gain is not None and run.frame.gain_map is not None:
        raise InputError(
            f"{run_file}: frame.gain_map: got it with gain, expected one of the two: leave one out"
        )
    named = run.frame.maps.items()
    return read_maps({name: resolve(path, run_file, must_exist=True) for name, path in named})


def noise_given(
    run: settings.RunSettings, run_file: Path, maps: PixelMaps, read_noise: float | None = None
) -> tuple[Noise, str]:
    """The noise of [noise] and of maps, and a line of what becomes of the header's read noise.

    Where neither [noise] nor a map says a read noise, it is the header's.
    """
    noise: Noise = run.noise.make()
    stated = "read_noise" in run.noise.model_fields_set
    for name in ("flat", "variance"):
        if getattr(maps, name) is not None and not isinstance(noise, PoissonNoise):
            raise InputError(
                f"{run_file}: frame.{name}: got it with noise.kind = {run.noise.kind!r}, expected "
                f"'poisson': leave out frame.{name}, or [noise]"
            )
    if maps.read_noise is not None:
        if stated:
            raise InputError(
                f"{run_file}: frame.variance: got it with noise.read_noise, expected one of the "
                "two: leave one out"
            )
        noise, read_noise = PoissonNoise(maps.read_noise), None
    line = ""
    if read_noise and getattr(noise, "read_noise", None) != read_noise:
        line = f"read noise: {read_noise:g} e- of the header not used, as [noise] says the noise"
        if isinstance(noise, PoissonNoise) and not stated:
            noise, line = (
                PoissonNoise(read_noise),
                f"read noise: {read_noise:g} e-, from the header",
            )
    if maps.flat is not None:
        noise = FlatFieldNoise(cast(PoissonNoise, noise), maps.flat)
    if run.frame.noise_correlation_ratio is not None:
        noise = CorrelatedNoise(noise, run.frame.noise_correlation_ratio)
    return noise, line


def posterior_given(
    run: settings.RunSettings,
    model: ForwardModel,
    counts: Floats,
    mask: Flags | None,
    noise: Noise,
) -> Posterior:
    """The posterior of a frame with the nuisances and priors of the run file."""
    nuisances, prior = run.nuisances.make(), priors_given(run)
    if run.frame.background_scale is not None and nuisances.footprint is None:
        raise InputError(
            "frame.background_scale: got it without nuisances.footprint, expected both: the "
            "background is measured outside the footprints"
        )
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
    maps = maps_given(run, run_file)
    noise, _ = noise_given(run, run_file, maps)
    if maps.valid is not None and maps.valid.shape != s.shape:
        raise InputError(
            f"{run_file}: simulation.shape: got {s.shape}, expected {maps.valid.shape}, that of "
            f"{maps.description}"
        )
    with naming(run_file):
        counts = simulate(model, theta, s.background, seed=seed, noise=noise)
        posterior = posterior_given(run, model, counts, maps.valid, noise)
    known = {**dict(zip(model.distortion.names, theta, strict=True)), "background": s.background}
    known |= {"flux_scale": 1.0, "psf_sigma": model.psf.sigma}
    truth = np.array([known.get(name, 0.0) for name in posterior.parameter_names])
    if not np.all(np.isfinite(posterior.expected_counts(truth))):
        raise InputError(
            f"{run_file}: simulation.theta: got a distortion that folds a source's image, "
            "expected a weaker one"
        )
    return posterior, truth

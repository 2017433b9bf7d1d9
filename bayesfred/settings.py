"""The run file: one TOML file that says what a run fits, to what, and how.

Each section is a frozen model with the keys, units and defaults of the run file;
:func:`read_settings` checks all of them at once and says every mistake in one line. Settings know
only plain values: the command line turns them into a model, `model_dump_json` turns them into the
text that result files keep, and :func:`resolve` finds the files they name. `example.toml` beside
this module is a complete run file. Frames and catalogues are read in `bayesfred.io.files`.
"""

from __future__ import annotations

import difflib
import inspect
import json
import re
import reprlib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from bayesfred.errors import InputError

__all__ = ["PriorSettings", "RunSettings", "read_settings", "resolve", "within"]

# Far outside what frames need, and far inside what float64, int64 and memory hold.
_LARGEST = 1e15
_Name = Annotated[str, Field(min_length=1, max_length=1000)]
_Float = Annotated[float, Field(ge=-_LARGEST, le=_LARGEST)]
_Positive = Annotated[float, Field(gt=0, le=_LARGEST)]
_NotNegative = Annotated[float, Field(ge=0, le=_LARGEST)]
_Count = Annotated[int, Field(ge=1, le=10**15)]
_Binning = Annotated[int, Field(ge=1, le=1000)]
_Power = Annotated[int, Field(ge=0, le=10)]
_Seed = Annotated[int, Field(ge=0, lt=2**63)]
_Term = tuple[_Power, _Power, _Power, _Power]

_TOO_DEEP = "got tables or arrays nested too deeply, expected sections of key = value"


class _Section(BaseModel):
    # strict: TOML has types of its own, so 'true' or '3' is never taken for a number.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class FrameSettings(_Section):
    """`[frame]`: the frame of counts, as `bayesfred.io.files.read_frame` takes it.

    Attributes
    ----------
    path : str
        The frame's file.
    gain : float, optional, e-/adu
        Counts are (stored - pedestal) * gain.
    pedestal : float, stored units
        Level that no light would give.
    saturation : float, optional, stored units
        Pixels at or above this level are masked.
    name : str, optional
        FITS extension or HDF5 dataset.
    reject_outliers : bool
        Whether spots of no source, and sources without a spot, are left out:
        `bayesfred.reject_outliers`.
    """

    path: _Name
    gain: _Positive | None = None
    pedestal: _Float = 0.0
    saturation: _Float | None = None
    name: _Name | None = None
    reject_outliers: bool = False


class CatalogueSettings(_Section):
    """`[catalogue]`: the known sources, as `bayesfred.io.files.read_catalogue` takes them.

    Attributes
    ----------
    path : str
        The catalogue's file.
    x, y : str
        Columns of the positions, pixel from the middle of the frame.
    flux : str
        Column of the fluxes, counts.
    magnitude : str, optional
        Column of magnitudes, in place of fluxes.
    zero_point : float, optional
        Magnitude of a source of one count; goes with `magnitude`.
    """

    path: _Name
    x: _Name = "x"
    y: _Name = "y"
    flux: _Name = "flux"
    magnitude: _Name | None = None
    zero_point: _Float | None = None

    @model_validator(mode="after")
    def _both_or_neither(self) -> CatalogueSettings:
        if (self.magnitude is None) != (self.zero_point is None):
            given = "magnitude" if self.zero_point is None else "zero_point"
            raise ValueError(f"got {given} alone, expected magnitude and zero_point together")
        return self


class DetectorSettings(_Section):
    """`[detector]`: how pixels record light.

    Attributes
    ----------
    pixel : {'impulse', 'box'}
        The image at the pixel's centre, or its integral over the pixel.
    binning : int
        Fine pixels a side in each recorded pixel.
    """

    pixel: Literal["impulse", "box"] = "impulse"
    binning: _Binning = 1


class PSFSettings(_Section):
    """`[psf]`: the reference PSF, in pixels of the fine grid.

    Attributes
    ----------
    kind : {'gaussian', 'moffat', 'sampled'}
        Which of `GaussianPSF`, `MoffatPSF` and `SampledPSF` it is.
    sigma : float, pixel
        Of a Gaussian: standard deviation.
    fwhm : float, pixel
        Of a Moffat function: full width at half maximum.
    beta : float
        Exponent of its wings.
    path : str
        Of a sampled PSF: file of its samples, an image such as a frame's, its sides odd numbers of
        pixels.
    oversampling : float
        Samples per pixel.
    """

    kind: Literal["gaussian", "moffat", "sampled"] = "gaussian"
    sigma: _Positive | None = None
    fwhm: _Positive | None = None
    beta: Annotated[float, Field(gt=1, le=100)] | None = None
    path: _Name | None = None
    oversampling: Annotated[float, Field(ge=1, le=1001)] | None = None

    @model_validator(mode="after")
    def _keys_of_the_kind(self) -> PSFSettings:
        wanted = {
            "gaussian": ["sigma"],
            "moffat": ["fwhm", "beta"],
            "sampled": ["path", "oversampling"],
        }[self.kind]
        given = [
            key
            for key in ("sigma", "fwhm", "beta", "path", "oversampling")
            if getattr(self, key) is not None
        ]
        if given != wanted:
            raise ValueError(
                f"got {' and '.join(given) or 'no width'}, expected {' and '.join(wanted)} with "
                f"kind = '{self.kind}'"
            )
        return self


class DistortionSettings(_Section):
    """`[distortion]`: the terms of f and g, named as a basis or listed.

    Attributes
    ----------
    terms : {'mirrored', 'paper', 'pinhole', 'full_polynomial'}, optional
        A basis by name.
    degree : int, optional
        Highest total degree of the 'full_polynomial' basis.
    f_terms, g_terms : tuple of (i, j, m, n), optional
        Powers of x, y, u, v, one entry a term.
    """

    terms: Literal["mirrored", "paper", "pinhole", "full_polynomial"] | None = None
    degree: Annotated[int, Field(ge=2, le=10)] | None = None
    f_terms: tuple[_Term, ...] | None = None
    g_terms: tuple[_Term, ...] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> DistortionSettings:
        given = [key for key in ("terms", "f_terms", "g_terms") if getattr(self, key) is not None]
        if given not in (["terms"], ["f_terms", "g_terms"]):
            got = " and ".join(given) or "no terms"
            raise ValueError(f"got {got}, expected either terms, or both f_terms and g_terms")
        if self.terms == "full_polynomial" and self.degree is None:
            raise ValueError("got no degree, expected one with terms = 'full_polynomial'")
        if self.terms != "full_polynomial" and self.degree is not None:
            raise ValueError(
                f"got degree {self.degree}, expected it with terms = 'full_polynomial' only"
            )
        if not self.terms and not self.f_terms and not self.g_terms:
            raise ValueError("got f_terms and g_terms empty, expected at least one term")
        return self


class ModelSettings(_Section):
    """`[model]`: how expected counts are computed.

    Attributes
    ----------
    conserve_flux : bool
        Whether the kernel includes the determinant that keeps each source's flux.
    tolerance : float
        Pixels where the PSF is below this part of its peak are left out.
    """

    conserve_flux: bool = True
    tolerance: Annotated[float, Field(ge=0, lt=1)] = 1e-8


class NoiseSettings(_Section):
    """`[noise]`: the noise of the counts.

    Attributes
    ----------
    kind : {'poisson', 'background'}
        Poisson counts, or the paper's case in which the background alone is noisy.
    read_noise : float, e-
        Standard deviation of the read noise, with 'poisson' only.
    """

    kind: Literal["poisson", "background"] = "poisson"
    read_noise: _NotNegative = 0.0

    @model_validator(mode="after")
    def _read_noise_is_poisson(self) -> NoiseSettings:
        if self.kind == "background" and self.read_noise > 0:
            raise ValueError(
                f"got read_noise {self.read_noise}, expected it with kind = 'poisson' only"
            )
        return self


class NuisanceSettings(_Section):
    """`[nuisances]`: what a real frame leaves unknown besides the distortion.

    Attributes
    ----------
    flux : {'fixed', 'scale', 'free'}
        Fluxes as catalogued, times one common factor, or free for each source.
    offset : bool
        Whether a common shift of all sources is fitted.
    psf_sigma : bool
        Whether the PSF's width is fitted, whatever its kind: that of the Gaussian as wide at half
        maximum.
    background_order : {0, 1, 2}
        Order of the background's polynomial over the frame.
    footprint : float, optional, pixel
        Keep only pixels this near to a catalogued source.
    position_scatter : bool
        Whether sources lie off their catalogue positions, by errors of unknown standard deviation;
        with free fluxes.
    """

    flux: Literal["fixed", "scale", "free"] = "fixed"
    offset: bool = False
    psf_sigma: bool = False
    background_order: Literal[0, 1, 2] = 0
    footprint: _Positive | None = None
    position_scatter: bool = False


class PriorSettings(_Section):
    """`[prior.NAME]`: the prior of one parameter, a distribution of `scipy.stats`.

    Attributes
    ----------
    distribution : str
        Its name, such as 'norm'. Every other key of the table is one of its keyword parameters, a
        float.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float] = Field(init=False)

    distribution: _Name

    @property
    def keywords(self) -> dict[str, float]:
        """Keyword parameters of the distribution."""
        return dict(self.__pydantic_extra__)


class SamplingSettings(_Section):
    """`[sampling]`: how long and how widely to sample.

    Attributes
    ----------
    seed : int
        Seed of every random number.
    ensembles : int
        Independent ensembles.
    walkers : int
        Walkers in each, an even number.
    target_ess : int
        Effective samples of the slowest parameter at which sampling stops.
    steps : int, optional
        Total number of steps in place of that rule.
    """

    seed: _Seed = 1
    ensembles: Annotated[int, Field(ge=2, le=1000)] = 4
    walkers: Annotated[int, Field(ge=4, le=10_000, multiple_of=2)] = 32
    target_ess: _Count = 1000
    steps: _Count | None = None


class OutputSettings(_Section):
    """`[output]`: where the run is stored.

    Attributes
    ----------
    path : str, optional
        The chain file, .h5, inside the folder that the run is started in.
    """

    path: Annotated[str, Field(pattern=r"\.h5$")] | None = None


class GridSettings(_Section):
    """`[simulation.grid]`: a square grid of sources, written as the catalogue.

    Attributes
    ----------
    side : int
        Sources a side.
    spacing : float, pixel
        Distance between neighbours.
    flux : float, counts
        Flux of each source.
    """

    side: Annotated[int, Field(ge=1, le=1000)]
    spacing: _Positive
    flux: _Positive


class SimulationSettings(_Section):
    """`[simulation]`: the truth that `bayesfred simulate` draws a frame from.

    Attributes
    ----------
    shape : (int, int), pixel
        Rows and columns (ny, nx) of the frame.
    theta : dict of float
        Distortion coefficients by parameter name; terms that are not named are zero.
    background : float, counts per pixel
        Expected background.
    seed : int
        Seed of the noise.
    grid : GridSettings, optional
        Sources to write as the catalogue; without it the catalogue is read.
    """

    shape: tuple[_Count, _Count]
    theta: dict[str, _Float]
    background: _NotNegative
    seed: _Seed = 1
    grid: GridSettings | None = None


class StudySettings(_Section):
    """`[study]`: what `bayesfred study` simulates and fits.

    Attributes
    ----------
    kind : {'noise', 'sbc'}
        Fits of the truth of [simulation] at several noise levels, or simulation-based calibration:
        truths from the priors.
    replicates : int
        Frames of every noise level, or of the calibration.
    method : {'laplace', 'mcmc'}, optional
        The maximum with its Fisher information, or draws; by default the first for 'noise', the
        second for 'sbc'.
    seed : int
        Seed of every random number.
    background : tuple of float, optional, counts per pixel
        Noise levels; every combination of these and the following is one.
    flux : tuple of float, optional, counts
        Mean fluxes of the sources.
    sources : tuple of int, optional
        Numbers of sources: the brightest, and of equally bright ones those that lie farthest apart.
    psf_sigma : tuple of float, optional, pixel
        Widths of the PSF.
    exposure : tuple of float, optional
        Factors of flux and background together.
    path : str, optional
        The table of results, .ecsv, inside the folder that the study is started in.
    """

    kind: Literal["noise", "sbc"] = "noise"
    replicates: Annotated[int, Field(ge=2, le=10**7)] = 100
    method: Literal["laplace", "mcmc"] | None = None
    seed: _Seed = 1
    background: tuple[_Positive, ...] | None = None
    flux: tuple[_Positive, ...] | None = None
    sources: tuple[_Count, ...] | None = None
    psf_sigma: tuple[_Positive, ...] | None = None
    exposure: tuple[_Positive, ...] | None = None
    path: Annotated[str, Field(pattern=r"\.ecsv$")] | None = None


class RunSettings(_Section):
    """A whole run file, one attribute a section.

    Attributes
    ----------
    frame, catalogue, psf, distortion
        Sections that every run file has.
    detector, model, noise, nuisances, sampling, output
        Sections with defaults.
    prior : dict of PriorSettings
        Priors by parameter name, in place of the default ones.
    simulation : SimulationSettings, optional
        Used by `bayesfred simulate` and `bayesfred study`.
    study : StudySettings, optional
        Used by `bayesfred study` only.
    """

    frame: FrameSettings
    catalogue: CatalogueSettings
    detector: DetectorSettings = DetectorSettings()
    psf: PSFSettings
    distortion: DistortionSettings
    model: ModelSettings = ModelSettings()
    noise: NoiseSettings = NoiseSettings()
    nuisances: NuisanceSettings = NuisanceSettings()
    prior: dict[str, PriorSettings] = {}
    sampling: SamplingSettings = SamplingSettings()
    output: OutputSettings = OutputSettings()
    simulation: SimulationSettings | None = None
    study: StudySettings | None = None


def read_settings(path: str | Path) -> RunSettings:
    """Read and check a run file.

    Parameters
    ----------
    path : str or Path
        A TOML file such as `example.toml` beside this module.

    Returns
    -------
    RunSettings

    Raises
    ------
    InputError
        The file is missing or is not TOML; a key is unknown, missing or has a value out of range.
        All mistakes are named in the one line.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     run_file = Path(folder, "run.toml")
    ...     _ = run_file.write_text(Path(inspect.getfile(read_settings)).with_name("example.toml").read_text())
    ...     read_settings(run_file).psf.sigma
    10.0
    """
    path = Path(path)
    try:
        # A byte order mark, which some editors write, is not TOML.
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        # JSON is what result files keep, so a run file is checked by the rules it will be read back
        # with. Dates, which only TOML has, are no key's type.
        return RunSettings.model_validate_json(
            json.dumps(table, default=lambda date: {str(date): "date"})
        )
    except FileNotFoundError:
        raise InputError(f"{path}: no such file, expected a run file; check the path") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}), expected a run file"
        ) from error
    except RecursionError:
        raise InputError(f"{path}: {_TOO_DEEP}") from None
    except ValidationError as error:
        mistakes = "; ".join(_mistake(details) for details in error.errors(include_url=False))
        raise InputError(" ".join(f"{path}: {mistakes}".split())) from None
    except (
        ValueError
    ) as error:  # TOML syntax (its text gives line and column) and text that is not UTF-8
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: not TOML ({reason}), expected sections of key = value"
        ) from error


def _mistake(details: Any) -> str:
    """Say one of pydantic's errors as `section.key: got X, expected Y`."""
    location, kind, message = details["loc"], details["type"], details["msg"]
    where = ".".join(map(str, location))
    if kind == "json_invalid":
        return _TOO_DEEP
    if kind == "missing":
        return f"{where}: missing, expected a value"
    if kind == "extra_forbidden":
        known = _known_keys(location[:-1])
        near = difflib.get_close_matches(str(location[-1]), known, n=1)
        advice = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"
        return f"{where}: unknown key, {advice}"
    if kind == "value_error":
        return f"{where}: {details['ctx']['error']}"
    expected = re.sub(r"^\w+ should (be )?", "", message).replace("an object", "a table")
    expected = re.sub(r"^(greater|less)", r"a number \1", re.sub(r"^have ", "one with ", expected))
    return f"{where}: got {reprlib.repr(details['input'])}, expected {expected}"


def _known_keys(location: tuple[str | int, ...]) -> list[str]:
    """List the keys of the section at a location in the run file."""
    section: type[BaseModel] = RunSettings
    for key in location:
        annotation = section.model_fields[str(key)].annotation
        section = next(
            candidate
            for candidate in (annotation, *get_args(annotation))
            if inspect.isclass(candidate) and issubclass(candidate, BaseModel)
        )
    return list(section.model_fields)

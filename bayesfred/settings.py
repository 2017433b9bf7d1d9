"""The run file: one TOML file that says what a run fits, to what, and how.

Each section is a frozen model with the keys, units and defaults of the run file;
:func:`read_settings` checks all of them at once and says every mistake in one line. The sections
`[detector]`, `[psf]`, `[noise]` and `[nuisances]` have the fields of the class that they describe,
see `sections`; `kind` names the class. `build` makes the objects. `sections.toml` gives the text
that result files keep. `example.toml` beside this module is a complete run file.
"""

from __future__ import annotations

import json
import tomllib
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, PlainValidator, ValidationError, model_validator

from bayesfred._typing import PathLike
from bayesfred.errors import InputError
from bayesfred.sections import (
    LARGEST,
    TOO_DEEP,
    DistortionSettings,
    Float,
    Name,
    Section,
    described,
    mistake,
)

__all__ = ["PriorSettings", "RunSettings", "read_settings"]

_Positive = Annotated[float, Field(gt=0, le=LARGEST)]
_NotNegative = Annotated[float, Field(ge=0, le=LARGEST)]
_Count = Annotated[int, Field(ge=1, le=10**15)]
_Seed = Annotated[int, Field(ge=0, lt=2**63)]

# Sections with the fields of a class: `ObjectSettings`.
_Detector = Annotated[Any, PlainValidator(partial(described, "detector"))]
_PSF = Annotated[Any, PlainValidator(partial(described, "psf"))]
_Noise = Annotated[Any, PlainValidator(partial(described, "noise"))]
_Nuisances = Annotated[Any, PlainValidator(partial(described, "nuisances"))]


class FrameSettings(Section):
    """`[frame]`: the frame of counts, as `bayesfred.io.frames.read_frame` takes it.

    Attributes
    ----------
    path : str
        The frame's file.
    gain : float, optional, e-/adu
        Counts are (stored - pedestal) * gain; by default the header's.
    pedestal : float, optional, stored units
        Level that no light would give, by default 0.
    saturation : float, optional, stored units
        Pixels at or above this level are masked; by default the header's, or what seems saturated.
    name : str, optional
        FITS extension or HDF5 dataset.
    reject_outliers : bool
        Whether unmatched sources and spurious detections are left out:
        `bayesfred.reject_outliers`.
    """

    path: Name
    gain: _Positive | None = None
    pedestal: Float | None = None
    saturation: Float | None = None
    name: Name | None = None
    reject_outliers: bool = False


class CatalogueSettings(Section):
    """`[catalogue]`: the known sources, as `io.catalogues.read_catalogue` takes them.

    Attributes
    ----------
    path : str
        The catalogue's file.
    x, y : str
        Columns of the positions, pixel from the middle of the frame.
    flux : str
        Column of the fluxes, counts; not needed where [nuisances] has them free.
    magnitude : str, optional
        Column of magnitudes, in place of fluxes.
    zero_point : float, optional
        Magnitude of a source of one count; goes with `magnitude`.
    """

    path: Name
    x: Name = "x"
    y: Name = "y"
    flux: Name = "flux"
    magnitude: Name | None = None
    zero_point: Float | None = None

    @model_validator(mode="after")
    def _both_or_neither(self) -> CatalogueSettings:
        if (self.magnitude is None) != (self.zero_point is None):
            given = "magnitude" if self.zero_point is None else "zero_point"
            raise ValueError(f"got {given} alone, expected magnitude and zero_point together")
        return self


class ModelSettings(Section):
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


class PriorSettings(Section):
    """`[prior.NAME]`: the prior of one parameter, a distribution of `scipy.stats`.

    Attributes
    ----------
    distribution : str
        Its name, such as 'norm'. Every other key of the table is one of its keyword parameters, a
        float.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float] = Field(init=False)

    distribution: Name

    @property
    def keywords(self) -> dict[str, float]:
        """Keyword parameters of the distribution."""
        return dict(self.__pydantic_extra__)


class SamplingSettings(Section):
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


class OutputSettings(Section):
    """`[output]`: where the run is stored.

    Attributes
    ----------
    path : str, optional
        The chain file, .h5, inside the folder that the run is started in.
    """

    path: Annotated[str, Field(pattern=r"\.h5$")] | None = None


class GridSettings(Section):
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


class SimulationSettings(Section):
    """`[simulation]`: the truth of which `bayesfred simulate` makes a frame.

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
    theta: dict[str, Float]
    background: _NotNegative
    seed: _Seed = 1
    grid: GridSettings | None = None


class StudySettings(Section):
    """`[study]`: what `bayesfred study` simulates and fits.

    Attributes
    ----------
    kind : {'noise', 'sbc'}
        Fits of the truth of [simulation] at several noise levels, or of truths from the priors.
    replicates : int
        Frames of every noise level, or of the calibration.
    method : {'laplace', 'mcmc'}, optional
        Maximum and Fisher information, the default of 'noise', or draws, the default of 'sbc'.
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
    error : float, pixel
        The rms error of the displacement for which a noise study counts photons.
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
    error: _Positive = 0.01
    path: Annotated[str, Field(pattern=r"\.ecsv$")] | None = None


class RunSettings(Section):
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
    detector: _Detector = described("detector", {})
    psf: _PSF
    distortion: DistortionSettings
    model: ModelSettings = ModelSettings()
    noise: _Noise = described("noise", {})
    nuisances: _Nuisances = described("nuisances", {})
    prior: dict[str, PriorSettings] = Field(default_factory=dict)
    sampling: SamplingSettings = SamplingSettings()
    output: OutputSettings = OutputSettings()
    simulation: SimulationSettings | None = None
    study: StudySettings | None = None

    def seeded(self, seed: int) -> RunSettings:
        """The same run with other random numbers, and without a study."""
        parts = {"sampling": self.sampling, "simulation": self.simulation}
        update = {
            key: part.model_copy(update={"seed": seed})
            for key, part in parts.items()
            if part is not None
        }
        return self.model_copy(update={**update, "study": None})


def read_settings(path: PathLike) -> RunSettings:
    """Read and check a run file.

    Parameters
    ----------
    path : path-like
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
    >>> import bayesfred.settings
    >>> read_settings(Path(bayesfred.settings.__file__).with_name("example.toml")).psf.sigma
    10.0
    """
    path = Path(path)
    try:
        # A byte order mark, which some editors write, is not TOML.
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        # The rules are those of JSON. Dates, which only TOML has, are no key's type.
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
        raise InputError(f"{path}: {TOO_DEEP}") from None
    except ValidationError as error:
        errors = error.errors(include_url=False)
        mistakes = "; ".join(mistake(details, RunSettings, table) for details in errors)
        raise InputError(" ".join(f"{path}: {mistakes}".split())) from None
    # TOML syntax (its text gives line and column) and text that is not UTF-8
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: not TOML ({reason}), expected sections of key = value"
        ) from error

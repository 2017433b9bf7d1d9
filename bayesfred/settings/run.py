"""The run file of one frame: what a run fits, to what, and how.

Each section is a frozen model with the keys, units and defaults of the run file;
:func:`read_settings` checks all of them at once and says every mistake in one line. The sections
`[detector]`, `[psf]`, `[noise]` and `[nuisances]` have the fields of the class that they describe,
see `sections`; `kind` names the class. `frame` has those about the frame, and `joint` reads run
files of many frames. `sections.toml` gives the text that result files keep.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, PlainValidator, ValidationError

from bayesfred._typing import PathLike
from bayesfred.errors import InputError
from bayesfred.io.reading import require_file
from bayesfred.settings.frame import CatalogueSettings, FrameSettings, SkySettings
from bayesfred.settings.sections import (
    TOO_DEEP,
    Count,
    DistortionSettings,
    Name,
    Section,
    Seed,
    described,
    mistake,
)
from bayesfred.settings.simulation import DesignSettings, SimulationSettings, StudySettings

__all__ = [
    "OutputSettings",
    "PriorSettings",
    "RunSettings",
    "SamplingSettings",
    "checked",
    "read_settings",
    "refused",
    "run_table",
]

# Sections with the fields of a class: `ObjectSettings`.
_Detector = Annotated[Any, PlainValidator(partial(described, "detector"))]
_PSF = Annotated[Any, PlainValidator(partial(described, "psf"))]
_Noise = Annotated[Any, PlainValidator(partial(described, "noise"))]
_Nuisances = Annotated[Any, PlainValidator(partial(described, "nuisances"))]


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

    seed: Seed = 1
    ensembles: Annotated[int, Field(ge=2, le=1000)] = 4
    walkers: Annotated[int, Field(ge=4, le=10_000, multiple_of=2)] = 32
    target_ess: Count = 1000
    steps: Count | None = None


class OutputSettings(Section):
    """`[output]`: where the run is stored.

    Attributes
    ----------
    path : str, optional
        The chain file, .h5, inside the folder that the run is started in.
    """

    path: Annotated[str, Field(pattern=r"\.h5$")] | None = None


class RunSettings(Section):
    """A whole run file, one attribute a section.

    Attributes
    ----------
    frame, catalogue, psf, distortion
        Sections that every run file has.
    sky, detector, model, noise, nuisances, sampling, output
        Sections with defaults.
    prior : dict of PriorSettings
        Priors by parameter name, in place of the default ones.
    simulation : SimulationSettings, optional
        Used by `bayesfred simulate`, `bayesfred study` and `bayesfred design`.
    study : StudySettings, optional
        Used by `bayesfred study` only.
    design : DesignSettings, optional
        Used by `bayesfred design` only.
    """

    frame: FrameSettings
    catalogue: CatalogueSettings
    sky: SkySettings = SkySettings()
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
    design: DesignSettings | None = None

    def seeded(self, seed: int) -> RunSettings:
        """The same run with other random numbers, and without a study or a design."""
        parts = {"sampling": self.sampling, "simulation": self.simulation}
        update = {
            key: part.model_copy(update={"seed": seed})
            for key, part in parts.items()
            if part is not None
        }
        return self.model_copy(update={**update, "study": None, "design": None})


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
        The file is missing or is not TOML; a key is unknown, missing or has a value out of range;
        it is of many frames.
        All mistakes are named in the one line.

    Examples
    --------
    >>> import bayesfred.settings
    >>> read_settings(Path(bayesfred.settings.__file__).with_name("example.toml")).psf.sigma
    10.0
    """
    path = Path(path)
    table = run_table(path)
    if "frames" in table or "joint" in table:
        raise InputError(
            f"{path}: frames: got many frames, expected one in [frame]: [[frames]] and [joint] are "
            "for bayesfred fit and crosscheck"
        )
    run, mistakes = checked(table)
    if run is None:
        raise refused(path, mistakes)
    return run


def run_table(path: Path) -> dict[str, Any]:
    """The tables of a run file, unchecked.

    Parameters
    ----------
    path : Path

    Returns
    -------
    dict

    Raises
    ------
    InputError
        The file is missing or is not TOML.
    """
    require_file(path)  # a pipe would keep the run waiting
    try:
        # A byte order mark, which some editors write, is not TOML.
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}), expected a run file"
        ) from error
    except RecursionError:
        raise InputError(f"{path}: {TOO_DEEP}") from None
    # TOML syntax (its text gives line and column) and text that is not UTF-8
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: not TOML ({reason}), expected sections of key = value"
        ) from error


def checked(table: dict[str, Any]) -> tuple[RunSettings | None, list[str]]:
    """Check the tables of a run file.

    Parameters
    ----------
    table : dict

    Returns
    -------
    run : RunSettings or None
    mistakes : list of str
        All there are; none where there is a run.
    """
    try:
        # The rules are those of JSON. Dates, which only TOML has, are no key's type.
        return RunSettings.model_validate_json(
            json.dumps(table, default=lambda date: {str(date): "date"})
        ), []
    except RecursionError:
        return None, [TOO_DEEP]
    except ValidationError as error:
        errors = error.errors(include_url=False)
        return None, [mistake(details, RunSettings, table) for details in errors]


def refused(path: Path, mistakes: Sequence[str]) -> InputError:
    """The one line that refuses a run file.

    Parameters
    ----------
    path : Path
    mistakes : sequence of str

    Returns
    -------
    InputError
    """
    return InputError(" ".join(f"{path}: {'; '.join(mistakes)}".split()))

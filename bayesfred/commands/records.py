"""The records that commands return."""

from dataclasses import dataclass
from pathlib import Path

from bayesfred._typing import Floats
from bayesfred.analysis.comparison import Comparison
from bayesfred.analysis.design import Design
from bayesfred.analysis.diagnostics import Diagnostics
from bayesfred.analysis.field import DisplacementField
from bayesfred.analysis.noise_study import NoiseStudy
from bayesfred.analysis.photons import PhotonsNeeded
from bayesfred.analysis.sbc import SBCResult
from bayesfred.calibration.calibration import Calibration
from bayesfred.calibration.corrected import CorrectedFrame
from bayesfred.io.summary_table import Table
from bayesfred.model.posterior import Posterior
from bayesfred.sampling.chain import Chain

__all__ = [
    "Calibrated",
    "Compared",
    "Corrected",
    "JointResult",
    "Planned",
    "Result",
    "Simulated",
    "Study",
]


@dataclass(frozen=True, eq=False)
class Result:
    """What a finished run left.

    Attributes
    ----------
    chain : Chain
    diagnostics : Diagnostics
    field : DisplacementField
        How far the frame displaces its objects, and how well that is known.
    summary : astropy.table.Table
        The parameters, see `bayesfred.sampling.summary.summary`, with `Diagnostics.columns`.
    path, page, picture, sources : Path
        The files: the chain, its report, its picture and its table of sources.
    photons : PhotonsNeeded, optional
        What a smaller error would take, where that was asked.
    """

    chain: Chain
    diagnostics: Diagnostics
    field: DisplacementField
    summary: Table
    path: Path
    page: Path
    picture: Path
    sources: Path
    photons: PhotonsNeeded | None = None


@dataclass(frozen=True, eq=False)
class JointResult:
    """What a finished run of several frames left.

    Attributes
    ----------
    chain : Chain
        Of a `JointPosterior`.
    diagnostics : Diagnostics
        Of all frames together.
    summary : astropy.table.Table
        All parameters, as in `Result`; shared ones come first.
    shared : astropy.table.Table
        The rows about what frames share, with `corner` and `corner_sd`.
    frame_table : astropy.table.Table
        A row for each frame: `frame`, its name; `time`, where shared parameters drift; `sources`;
        `pixels` in the likelihood; `deviance_z`, in standard deviations of a true model's;
        `fits_data`; `agreement_p`, the probability that a frame with the same shared parameters
        differs as much from the others; `agrees`.
    gain : str
        One line: how much better the frames together know what they share.
    path, page, picture, sources : Path
        The files: the chain, the page of all frames, its picture, and one table of all sources.
    frames : dict of str to Result
        What there is of every frame. Its draws and its estimate are those of the joint posterior.
    """

    chain: Chain
    diagnostics: Diagnostics
    summary: Table
    shared: Table
    frame_table: Table
    gain: str
    path: Path
    page: Path
    picture: Path
    sources: Path
    frames: dict[str, Result]


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulated frame.

    Attributes
    ----------
    posterior : Posterior
        Its `counts` are the frame.
    truth : ndarray, shape (d,), parameter units
    frame : Path
        The frame's file.
    catalogue : Path or None
        The file of the sources, if they were made with the frame.
    """

    posterior: Posterior
    truth: Floats
    frame: Path
    catalogue: Path | None


@dataclass(frozen=True, eq=False)
class Planned:
    """What a planned frame would tell, and where it is.

    Attributes
    ----------
    plan : Design
    table, picture : Path
        The files: a row for each source, the one that tells most first, and the figure.
    """

    plan: Design
    table: Path
    picture: Path


@dataclass(frozen=True, eq=False)
class Study:
    """What a study found and where it is.

    Attributes
    ----------
    result : NoiseStudy or SBCResult
    table, summary, picture : Path
        The files: a row for each frame, the findings, their figure.
    """

    result: NoiseStudy | SBCResult
    table: Path
    summary: Path
    picture: Path

    @property
    def holds(self) -> bool:
        """Whether every frame could be fitted or, in a calibration, the error bars hold."""
        if isinstance(self.result, SBCResult):
            return self.result.calibrated
        return not self.result.cells["failed"].any()


@dataclass(frozen=True)
class Compared:
    """Runs side by side.

    Attributes
    ----------
    ranking : Comparison or None
        How well their models predict; None where they cannot be ranked.
    reason : str
        Why they cannot.
    page : Path or None
        The page, where one was asked for.
    """

    ranking: Comparison | None
    reason: str
    page: Path | None


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A calibration and its files.

    Attributes
    ----------
    calibration : Calibration
    files : dict of str to Path
        What each file is, and where.
    lines : tuple of str
        What is to be known of the files: errors of the export, in recorded pixels.
    """

    calibration: Calibration
    files: dict[str, Path]
    lines: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Corrected:
    """A corrected frame and its file.

    Attributes
    ----------
    frame : CorrectedFrame
    description : str
        What was read, in one line.
    path : Path
    """

    frame: CorrectedFrame
    description: str
    path: Path

"""A page with several runs side by side: verdicts, ranking, parameters, residuals on one scale.

The numbers are those of `bayesfred.analysis.comparison` and of each run's own diagnostics; the page
has the styles of a run's page, see `bayesfred.reporting.html`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayesfred._typing import PathLike
from bayesfred.analysis.comparison import Comparison
from bayesfred.analysis.diagnostics import Diagnostics
from bayesfred.io import atomic
from bayesfred.model.joint import JointPosterior
from bayesfred.reporting.figures import PageFigure, described_residual
from bayesfred.reporting.frames import FittedFrame, residual_panels
from bayesfred.reporting.html import (
    described_frames,
    described_model,
    embedded_figures,
    made_with,
    render,
)
from bayesfred.reporting.labels import html_symbol, html_unit, scale_of
from bayesfred.reporting.style import png
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.record import RunRecord

__all__ = ["ComparedRun", "write_comparison"]


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """One of the runs that a page compares.

    Attributes
    ----------
    name : str
        What the ranking calls it, such as its file.
    chain : Chain
    diagnostics : Diagnostics
        What `diagnose` said of `chain`.
    """

    name: str
    chain: Chain
    diagnostics: Diagnostics

    @property
    def described(self) -> dict[str, Any]:
        """What the page says of the run alone."""
        chain = self.chain
        record = chain.record or RunRecord(Path(self.name).stem)
        posterior = chain.posterior()
        several = isinstance(posterior, JointPosterior)
        return {
            "name": self.name,
            "title": record.title or Path(self.name).stem,
            "model": described_frames(posterior) if several else described_model(record, posterior),
            "made": made_with(chain),
            "diagnostics": self.diagnostics,
        }


def write_comparison(
    path: PathLike, runs: Sequence[ComparedRun], ranking: Comparison | None, reason: str = ""
) -> Path:
    """Write a page with several runs side by side as one HTML file, in one step.

    Parameters
    ----------
    path : path-like
        Where the page goes; an existing file is replaced.
    runs : sequence of ComparedRun
        At least two.
    ranking : Comparison or None
        How well the runs' models predict; None where they cannot be ranked.
    reason : str, optional
        Why they cannot.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    InputError
        If the page cannot be written.
    """
    path = Path(path)
    number = {run.name: k for k, run in enumerate(runs, 1)}
    names = [run.chain.parameter_names for run in runs]
    common = [name for name in names[0] if all(name in other for other in names)]
    page = render(
        "comparison.html",
        title=f"Comparison of {len(runs)} runs: {', '.join(number)}",
        runs=[run.described for run in runs],
        ranking=ranking,
        reason=reason,
        number=number,
        rows=[_row(name, runs) for name in common],
        others=[[name for name in own if name not in common] for own in names],
        figures=embedded_figures(_residuals(runs)),
    )
    atomic.replace(path, page)
    return path


def _row(name: str, runs: Sequence[ComparedRun]) -> dict[str, Any]:
    """A parameter's cells: its value in each run, and how far the later ones are from the first."""
    parameter = next(p for p in runs[0].chain.posterior().parameters if p.name == name)
    draws = [run.chain.draws()[:, run.chain.parameter_names.index(name)] for run in runs]
    means, sds = [float(np.mean(d)) for d in draws], [float(np.std(d, ddof=1)) for d in draws]
    scale = scale_of(max(means, key=abs), min(sds))
    differences = [
        (mean - means[0]) / max(sd, sds[0]) if max(sd, sds[0]) > 0 else float("nan")
        for mean, sd in zip(means[1:], sds[1:], strict=True)
    ]
    return {
        "symbol": html_symbol(parameter),
        "unit": html_unit(parameter, scale.exponent),
        "values": [
            f"{scale.number(mean)} ± {scale.number(sd)}".replace("-", "−")
            for mean, sd in zip(means, sds, strict=True)
        ],
        "differences": [f"{difference:+.2f}".replace("-", "−") for difference in differences],
    }


def _residuals(runs: Sequence[ComparedRun]) -> list[PageFigure]:
    """Residuals of every run; those of several frames are on the frames' own pages."""
    if any(isinstance(run.chain.posterior(), JointPosterior) for run in runs):
        return []
    fitted = [FittedFrame.at(run.chain.posterior(), run.chain.estimate.params) for run in runs]
    return [
        PageFigure(
            "Residuals",
            "At each run's MAP, on one scale. Green pixels do not enter the likelihood.",
            " ".join(f"Run {k}: {described_residual(frame)}" for k, frame in enumerate(fitted, 1)),
            png(residual_panels(fitted)),
        )
    ]

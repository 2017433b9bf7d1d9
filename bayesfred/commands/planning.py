"""Commands before an exposure: what a planned frame would tell."""

from pathlib import Path
from typing import Any

import numpy as np

from bayesfred import build, settings
from bayesfred._typing import PathLike
from bayesfred.analysis import design as designs
from bayesfred.build import naming
from bayesfred.commands.records import Planned
from bayesfred.errors import InputError
from bayesfred.io import atomic, outputs, paths, tables
from bayesfred.model.parameters import SCALES
from bayesfred.model.posterior import Posterior
from bayesfred.reporting.design import design_plot
from bayesfred.reporting.style import png
from bayesfred.settings.simulation import DesignSettings

__all__ = ["design"]

META = {
    "source": "row in the catalogue, from 0",
    "x, y, u, v": "object plane and image, fine pixel from the middle of the frame",
    "rms, largest": "error with this source and those above it, fine pixel",
}


def design(run_file: PathLike, *, overwrite: bool = False) -> Planned:
    """Plan the frame of a run file's [simulation]: its errors, the best sources and pointings.

    Parameters
    ----------
    run_file : path-like
        Its [simulation] describes the frame, and [design], which it need not have, what is asked.
    overwrite : bool
        Replace table and picture.

    Returns
    -------
    Planned

    Raises
    ------
    InputError
        If the run file is unusable, has no [simulation], cannot be planned, or a file exists.
    """
    run_file = Path(run_file)
    run = settings.read_settings(run_file)
    if run.distortion.terms == "choose":
        raise InputError(
            f"{run_file}: distortion.terms: got 'choose', expected the terms themselves: a design "
            "is of one model"
        )
    s = run.design or DesignSettings()
    given = s.path or Path("chains", f"{run_file.stem}.design.ecsv")
    table = paths.within(".", given, f"{run_file}: design.path")
    picture = table.with_suffix(".png")
    inputs = build.inputs(run, run_file)
    paths.may_write(table, overwrite=overwrite, beside=(picture,), inputs=inputs)
    posterior, truth = build.simulated(run, run_file, build.simulation(run, run_file).seed)
    # a scale of zero has no density: sources scatter, and the model errs, as much as a fit assumes
    starts = zip(posterior.parameters, truth, strict=True)
    truth = np.array([q.start if q.name in SCALES else value for q, value in starts])
    with naming(run_file):
        plan = designs.design(
            posterior, truth, error=s.error, criterion=s.criterion, sources=s.sources,
            dithers=s.dithers, frames=s.frames,
        )  # fmt: skip
    if s.path is None:
        outputs.make_folder(table)
    paths.may_write(table, overwrite=overwrite, beside=(picture,))  # they may have come since
    tables.write_table(table, _record(plan, posterior), overwrite=overwrite)
    atomic.replace(picture, png(design_plot(plan), 150))
    return Planned(plan, table, picture)


def _record(plan: designs.Design, posterior: Posterior) -> tables.TableRecord:
    """A row for each source, the one that tells most first; the pointings in the table's meta."""
    choice, sources = plan.sources, posterior.model.sources
    order = choice.order
    columns = {
        "source": order,
        "x": sources.x[order],
        "y": sources.y[order],
        "u": plan.images[order, 0],
        "v": plan.images[order, 1],
        "rms": choice.rms,
        "largest": choice.largest,
        "rms_at_random": plan.random_rms,
        "chosen": np.isin(order, choice.chosen).astype(int),
    }
    meta: dict[str, Any] = {**META, "criterion": plan.criterion, "message": " ".join(plan.lines)}
    if plan.frames is not None:
        frames = plan.dithers[plan.frames.chosen]
        meta["pointings of the chosen frames, fine pixel"] = frames.tolist()
    return tables.TableRecord(columns, meta)

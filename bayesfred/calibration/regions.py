"""The residuals of a fit as regions for DS9: circles at the images, arrows of the displacements.

A region file counts pixels from 1 at the middle of the first. An arrow points from where the
distortion has an image to where the counts have it, enlarged by a factor that the file states.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bayesfred._typing import PathLike
from bayesfred.errors import InputError
from bayesfred.io.atomic import replace
from bayesfred.io.paths import may_write
from bayesfred.io.summary_table import Table

__all__ = ["ENLARGEMENT", "residual_regions", "write_regions"]

ENLARGEMENT = 100.0
RADIUS = 5.0  # recorded pixel, of the circles
COLOURS = {False: "green", True: "red"}  # a source that agrees with the counts, one that does not


def residual_regions(
    sources: Table, shape: tuple[int, int], *, enlargement: float = ENLARGEMENT
) -> str:
    """Regions of the sources of a fit.

    Parameters
    ----------
    sources : astropy.table.Table
        Of a diagnosis, `bf.diagnose(chain).sources`: u, v, du and dv in recorded pixels.
    shape : (int, int), recorded pixel
        Rows and columns of the frame.
    enlargement : float
        Pixels of an arrow per pixel of displacement.

    Returns
    -------
    str
        The region file. Sources that fail the diagnosis are red. One without an image in the frame
        has no circle, one whose displacement the counts do not tell no arrow.

    Raises
    ------
    InputError
        If the table has no such columns, or the enlargement is not a number above 0.

    Examples
    --------
    >>> table = Table({"id": [7], "u": [-1.5], "v": [2.0], "n_pixels": [9], "du": [0.0],
    ...     "dv": [0.02], "failed": [False]})
    >>> print(residual_regions(table, (5, 4)))
    # Region file format: DS9 version 4.1
    # Arrows: displacement of an image from where the distortion has it, 100 times enlarged.
    # Red: sources that do not agree with the counts.
    image
    circle(1.0000,5.0000,5) # color=green text={7}
    # vector(1.0000,5.0000,2.0000,90.0000) vector=1 color=green
    <BLANKLINE>
    """
    missing = {"id", "u", "v", "n_pixels", "du", "dv", "failed"} - set(sources.colnames)
    if missing:
        raise InputError(
            f"sources: got no column {', '.join(sorted(missing))}, expected the table of sources "
            "of a diagnosis"
        )
    if not 0.0 < enlargement < np.inf:
        raise InputError(f"enlargement: got {enlargement}, expected a number above 0")
    rows, columns = shape
    lines = [
        "# Region file format: DS9 version 4.1",
        "# Arrows: displacement of an image from where the distortion has it, "
        f"{enlargement:g} times enlarged.",
        "# Red: sources that do not agree with the counts.",
        "image",
    ]
    for source in sources:
        column, row = source["u"] + 0.5 * (columns + 1), source["v"] + 0.5 * (rows + 1)
        if not source["n_pixels"] or not np.isfinite(column + row):
            continue
        at, colour = f"{column:.4f},{row:.4f}", COLOURS[bool(source["failed"])]
        lines.append(f"circle({at},{RADIUS:g}) # color={colour} text={{{source['id']}}}")
        length = enlargement * np.hypot(source["du"], source["dv"])
        if np.isfinite(length):
            angle = np.degrees(np.arctan2(source["dv"], source["du"])) % 360.0
            lines.append(f"# vector({at},{length:.4f},{angle:.4f}) vector=1 color={colour}")
    return "\n".join(lines) + "\n"


def write_regions(
    path: PathLike,
    sources: Table,
    shape: tuple[int, int],
    *,
    enlargement: float = ENLARGEMENT,
    overwrite: bool = False,
) -> None:
    """Write the regions of the sources of a fit as a file for DS9.

    Parameters
    ----------
    path : path-like
    sources : astropy.table.Table
    shape : (int, int), recorded pixel
    enlargement : float
        As for `residual_regions`.
    overwrite : bool
        Replace a file that exists.

    Raises
    ------
    InputError
        If the file exists or cannot be written, or as `residual_regions`.
    """
    may_write(path, overwrite=overwrite)
    replace(Path(path), residual_regions(sources, shape, enlargement=enlargement).encode())

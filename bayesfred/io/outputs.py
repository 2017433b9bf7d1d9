"""Which files a run leaves beside its chain, and whether they may be written.

`paths.may_write` is the rule for any file; here it is applied to the page of a run and what is
written with it.
"""

from collections.abc import Sequence
from pathlib import Path

from bayesfred.errors import InputError
from bayesfred.io import atomic
from bayesfred.io.paths import may_write

__all__ = ["beside", "beside_study", "make_folder", "may_write_page", "of_frame", "psf_beside"]


def beside(path: Path) -> tuple[Path, Path, Path]:
    """Name the page, the picture and the table of sources of a chain file, or those of a page.

    Parameters
    ----------
    path : Path

    Returns
    -------
    page, picture, sources : Path

    Examples
    --------
    >>> [path.name for path in beside(Path("run.h5"))]
    ['run.html', 'run.png', 'run.sources.ecsv']
    """
    page, picture, sources = (path.with_suffix(s) for s in (".html", ".png", ".sources.ecsv"))
    return page, picture, sources


def of_frame(path: Path, name: str) -> Path:
    """Name what is written of one of several frames: `beside` and `psf_beside` name its files.

    Parameters
    ----------
    path : Path
        The chain file of all frames, or their page.
    name : str
        The frame's.

    Returns
    -------
    Path

    Examples
    --------
    >>> [path.name for path in beside(of_frame(Path("run.h5"), "night2"))]
    ['run.night2.html', 'run.night2.png', 'run.night2.sources.ecsv']
    """
    return path.with_suffix(f".{name}{path.suffix}")


def psf_beside(path: Path) -> Path:
    """Name the file of a PSF that was measured with a chain.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Path

    Examples
    --------
    >>> psf_beside(Path("run.h5")).name
    'run.psf.fits'
    """
    return path.with_suffix(".psf.fits")


def beside_study(table: Path) -> tuple[Path, Path]:
    """Name the summary and the picture of a study's table.

    Parameters
    ----------
    table : Path

    Returns
    -------
    summary, picture : Path

    Examples
    --------
    >>> [path.name for path in beside_study(Path("run.noise.ecsv"))]
    ['run.noise.summary.ecsv', 'run.noise.png']
    """
    return table.with_name(f"{table.stem}.summary.ecsv"), table.with_suffix(".png")


def may_write_page(page: Path, *others: Path, inputs: Sequence[Path], overwrite: bool) -> None:
    """Refuse a page that nobody asked to replace, or that cannot be written where it should go.

    Parameters
    ----------
    page : Path
    *others : Path
        Files that are written with it.
    inputs : sequence of Path
        Chain files that it is made of.
    overwrite : bool
        Whether page and others may be replaced.

    Raises
    ------
    InputError
        If a file exists, the page is not called NAME.html, its folder is missing, or a chain would
        be replaced.
    """
    if page.suffix != ".html":
        raise InputError(f"{page}: got a page with another suffix, expected NAME.html")
    if not page.parent.is_dir():
        raise InputError(f"{page}: no folder {page.parent}, expected one to write to: create it")
    may_write(page, overwrite=overwrite, beside=others, inputs=inputs)


def make_folder(path: Path) -> None:
    """Create the folder of an output file, unless it exists.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    InputError
        If the folder cannot be created.
    """
    with atomic.writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)

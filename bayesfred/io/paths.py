"""Which files a run reads and writes: where they are, and what may be replaced.

:func:`resolve` finds the files that a run file names, :func:`within` keeps what is written inside a
folder, and :func:`may_write` is the one answer to "the file exists": refuse, resume or overwrite,
but never what is read. Of a run that is resumed `marks.may_replace` tells which files are its own.
"""

import errno
import os
from collections.abc import Sequence
from pathlib import Path

from bayesfred._typing import PathLike
from bayesfred.errors import InputError

__all__ = ["hidden", "may_write", "require_plain", "resolve", "within"]


def may_write(
    path: PathLike,
    *,
    overwrite: bool,
    resume: bool | None = None,
    beside: Sequence[PathLike] = (),
    inputs: Sequence[PathLike] = (),
) -> bool:
    """Refuse to replace files that are read, or that nobody asked to replace.

    Parameters
    ----------
    path : path-like
        The file to write.
    overwrite : bool
        Whether what is there may be replaced.
    resume : bool, optional
        Whether a run that is there may be resumed; None where the file holds no run.
    beside : sequence of path-like
        Files that are rebuilt with it, such as the page of a run. Whether those of a run that is
        resumed may be replaced is asked of `marks.may_replace`.
    inputs : sequence of path-like, optional
        Files that are read: they are not replaced, whatever the choices.

    Returns
    -------
    bool
        Whether there is a run to resume.

    Raises
    ------
    InputError
        A file exists, and neither choice allows it; a file is one that is read, under whatever
        name; or both choices are made.

    Examples
    --------
    >>> may_write("no_such_file.h5", overwrite=False, resume=True)
    False
    >>> may_write(".", overwrite=False)
    Traceback (most recent call last):
    ...
    bayesfred.errors.InputError: .: exists, expected a new file: write elsewhere, or replace it ...
    """
    if resume and overwrite:
        raise InputError(
            f"{path}: got both --resume and --overwrite, expected one: resume what is there, or "
            "replace it"
        )
    for read in inputs:
        for place in (path, *beside, *hidden(Path(path))):
            if _same(place, read):
                raise InputError(
                    f"{place}: got a file that is read, expected another to write: rename it, or "
                    "write elsewhere"
                )
    resumed = bool(resume) and os.path.lexists(path)
    for place in () if overwrite or resumed else (path, *beside):
        if os.path.lexists(place):
            choice = "resume it with --resume" if place == path and resume is not None else None
            raise InputError(
                f"{place}: exists, expected a new file: {choice or 'write elsewhere'}, or replace "
                "it with --overwrite"
            )
    return resumed


def hidden(path: Path) -> tuple[Path, Path, Path]:
    """Name what the writer of a chain or a study uses: the lock, its holder, a temporary file.

    Parameters
    ----------
    path : Path
        The chain or the table.

    Returns
    -------
    lock, holder, temporary : Path

    Examples
    --------
    >>> [path.name for path in hidden(Path("run.h5"))]
    ['.run.h5.lock', '.run.h5.writer', '.run.h5.tmp']
    """
    lock, holder, temporary = (
        path.with_name(f".{path.name}.{kind}") for kind in ("lock", "writer", "tmp")
    )
    return lock, holder, temporary


def require_plain(*places: Path) -> None:
    """Refuse links and folders in the places of files.

    Parameters
    ----------
    *places : Path
        Where files are to be written.

    Raises
    ------
    InputError
        One of them is a link or a folder.
    """
    for place in places:
        if os.path.islink(place) or os.path.isdir(place):
            raise InputError(
                f"{place}: got a link or a folder, expected a file or nothing there: remove it, or "
                "write elsewhere"
            )


def _same(place: PathLike, read: PathLike) -> bool:
    """Whether two paths lead to one file: equal, or by links of either kind."""
    try:
        return os.path.samefile(place, read)
    except (OSError, ValueError):  # one is not there
        return False


def resolve(path: PathLike, run_file: PathLike, *, must_exist: bool = False) -> Path:
    """Find a file that a run file names.

    Parameters
    ----------
    path : path-like
        As the run file gives it. An absolute path stays; a relative one is looked up beside the run
        file, then in the folder that the environment variable BAYESFRED_DATA names.
    run_file : path-like
        The run file.
    must_exist : bool
        Raise where nothing is found, and say where it was looked for.

    Returns
    -------
    Path
        The file found, or else the place beside the run file.

    Raises
    ------
    InputError
        With `must_exist`, where there is no such file.

    Examples
    --------
    >>> resolve("frame.fits", "no_such_folder/run.toml").as_posix()
    'no_such_folder/frame.fits'
    """
    folder = os.environ.get("BAYESFRED_DATA")
    places = [Path(run_file).parent / path]
    if folder and not Path(path).is_absolute():
        places.append(Path(folder) / path)
    # `Path.exists` raises for some paths that no file can have
    found = next((place for place in places if os.path.exists(place)), None)
    if found is None and must_exist:
        remedy = "check the path"
        if not Path(path).is_absolute():
            remedy += " or set BAYESFRED_DATA to the folder that holds it"
        tried = " or ".join(map(str, places))
        raise InputError(f"{run_file}: got {str(path)!r}, expected a file at {tried}; {remedy}")
    return found or places[0]


def within(folder: PathLike, path: PathLike, where: str) -> Path:
    """Find the place of a file to write, which must be inside a folder whatever a run file says.

    Parameters
    ----------
    folder : path-like
        The folder.
    path : path-like
        As the run file gives it, relative to the folder.
    where : str
        Run file and key, to begin the line with.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        The path leads out of the folder, by being absolute, by .. or through links, or it is no
        path.

    Examples
    --------
    >>> within("chains", "night/one.h5", "run.toml: output.path").as_posix()
    'chains/night/one.h5'
    >>> within("chains", "../one.h5", "run.toml: output.path")
    Traceback (most recent call last):
    ...
    bayesfred.errors.InputError: run.toml: output.path: got '../one.h5', which leads out of ...
    """
    place = Path(folder) / path
    inside = False
    try:
        inside = place.resolve().is_relative_to(Path(folder).resolve())
        os.stat(place)
    # From Python 3.13 on `resolve` accepts a loop of links. Other faults show on opening the file.
    except OSError as error:
        inside = inside and error.errno != errno.ELOOP
    except (RuntimeError, ValueError):  # a loop of links, a zero byte
        pass
    if not inside:
        leads = f"{str(path)!r}, which leads out of {Path(folder).absolute()}"
        raise InputError(f"{where}: got {leads}, expected a path that stays inside")
    return place

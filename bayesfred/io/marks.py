r"""Whether a run made a file: the mark that pages, pictures, tables and PSFs carry.

A run that is resumed replaces what it has written beside its chain or table before, and nothing
else. Which files those are is written in the files themselves: each has one line

    bayesfred run RUN content SHA256

with what the run is known by and the hash of the file without the mark. So a file of somebody else,
one of another run, and one that was edited since are told from the run's own, also after all of
them were copied elsewhere. The line stands where the format has a place for it: after the end of a
page, in the heading of a table, as a text in a picture. A FITS file has it as two cards.
"""

import hashlib
import os
import zlib
from pathlib import Path

from bayesfred.errors import InputError

__all__ = ["fits_mark", "marked", "may_replace"]

_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", 12  # how pictures begin, and the size of their last chunk
_TABLE = b"# %ECSV 1.0\n# ---\n"
_FITS, _CARD = b"SIMPLE  =", 80
_RUN, _CONTENT = "BFRUN", "BFCONT"
# Cards that come and go with the mark and the checksums, which hold the time of writing.
_NO_CONTENT = (b"CHECKSUM", b"DATASUM ", *(f"{key:8}".encode() for key in (_RUN, _CONTENT)))


def marked(content: bytes, run: str) -> bytes:
    r"""The content of a file with the mark of a run.

    Parameters
    ----------
    content : bytes
        An HTML page, a PNG picture or an ECSV table.
    run : str
        What the run is known by, of one length for all runs.

    Returns
    -------
    bytes

    Examples
    --------
    >>> marked(b"<html></html>\n", "1234")[14:51]
    b'<!-- bayesfred run 1234 content b0693'
    """
    place = _place(content)
    return content[:place] + _mark(content, run) + content[place:]


def _place(content: bytes) -> int:
    """Where a mark goes."""
    if content.startswith(_PNG):
        return len(content) - _PNG_END
    return len(_TABLE) if content.startswith(_TABLE) else len(content)


def _mark(content: bytes, run: str) -> bytes:
    line = f"bayesfred run {run} content {hashlib.sha256(content).hexdigest()}".encode()
    if content.startswith(_PNG):
        chunk = b"tEXtSource\0" + line
        size, check = len(chunk) - 4, zlib.crc32(chunk)
        return size.to_bytes(4, "big") + chunk + check.to_bytes(4, "big")
    return b"# # " + line + b"\n" if content.startswith(_TABLE) else b"<!-- " + line + b" -->\n"


def fits_mark(content: bytes, run: str) -> dict[str, str]:
    """The cards that mark a FITS file as a run's.

    Parameters
    ----------
    content : bytes
        The file, with or without these cards and checksums.
    run : str
        What the run is known by.

    Returns
    -------
    dict of str to str
        Cards for the first heading.
    """
    cards = (content[k : k + _CARD] for k in range(0, len(content), _CARD))
    kept = (card for card in cards if card.strip() and not card.startswith(_NO_CONTENT))
    return {_RUN: run, _CONTENT: hashlib.sha256(b"".join(kept)).hexdigest()}


def may_replace(run: str, *places: Path) -> None:
    """Refuse to replace files that a run did not make, or that were changed since.

    Parameters
    ----------
    run : str
        What the run is known by.
    *places : Path
        Files that are to be written with its mark.

    Raises
    ------
    InputError
        One of them exists and the run did not write it.
    """
    for place in places:
        if os.path.lexists(place) and not _made_by(place, run):
            raise InputError(
                f"{place}: exists, and is not as this run wrote it, expected the run's own file or "
                "none: move it away"
            )


def _made_by(place: Path, run: str) -> bool:
    """Whether a file is marked by a run, and is what the mark says."""
    try:
        content = place.read_bytes() if place.is_file() else b""
    except OSError:  # not ours to read
        return False
    if content.startswith(_FITS):
        cards = (f"{key:8}= '{value}'" for key, value in fits_mark(content, run).items())
        return all(card.encode() in content for card in cards)
    size = len(_mark(content, run))
    begin = _place(content) - (0 if content.startswith(_TABLE) else size)
    return marked(content[:begin] + content[begin + size :], run) == content

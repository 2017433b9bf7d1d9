"""What a run was: its title, frame, settings, notes and date, kept with its draws.

The numbers of a chain do not say where its frame came from or what a simulation put in. The chain
file stores this record beside them, so that a report can be written again from the file alone.
"""

from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import numpy as np

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable

__all__ = ["RunRecord"]

LONGEST = 60_000  # bytes of a text; a chain file's attribute holds 65,536


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


@serializable("run_record")
@dataclass(frozen=True, eq=False)
class RunRecord:
    """What is told of a run beside its draws.

    Attributes
    ----------
    title : str
        Heading of the report.
    frame : str
        Name of the frame, such as its file's.
    settings : str or None
        A run file, TOML, that makes the same run again.
    notes : tuple of str
        Paragraphs of plain text, such as what was read and what was left out.
    truth : ndarray, shape (d,), parameter units, or None
        Parameters of the simulation that made the frame.
    made : str
        Date and time in UTC, ISO 8601; by default now.

    Raises
    ------
    InputError
        If a text is longer than 60,000 bytes, the truth is not a vector of finite numbers, or the
        date is none.

    Examples
    --------
    >>> record = RunRecord("night 3", frame="frame.fits", made="2026-11-22T04:00:00+00:00")
    >>> record.title, record.truth is None
    ('night 3', True)
    """

    title: str = ""
    frame: str = ""
    settings: str | None = None
    notes: tuple[str, ...] = ()
    truth: Floats | None = None
    made: str = field(default_factory=_now)

    def __post_init__(self) -> None:
        for name in ("title", "frame", "settings", "notes"):
            size = _size(name, getattr(self, name))
            if size > LONGEST:
                raise InputError(
                    f"{name}: got {size} bytes, expected at most {LONGEST}, which a chain file "
                    "can hold: shorten it"
                )
        if self.truth is not None and not (
            np.ndim(self.truth) == 1 and np.isfinite(self.truth).all()
        ):
            raise InputError("truth: got other than a vector of finite numbers, expected one")
        try:
            utc = datetime.fromisoformat(self.made).utcoffset() == timedelta(0)
        except ValueError:
            utc = False
        if not utc:
            raise InputError(
                f"made: got {self.made!r}, expected a date and time in UTC, such as "
                "2026-11-22T04:00:00+00:00"
            )


def _size(name: str, text: str | tuple[str, ...] | None) -> int:
    """Bytes that a text takes in a file; those of a tuple are as long as the longest."""
    try:
        if isinstance(text, tuple):
            return len(text) * max((len(item.encode()) for item in text), default=0)
        return len((text or "").encode())
    except UnicodeEncodeError:
        raise InputError(
            f"{name}: got characters that are not Unicode, expected none: escape them"
        ) from None

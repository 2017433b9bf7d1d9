"""What the table of a study says of itself: which study it is, and what made which rows."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayesfred.errors import InputError
from bayesfred.io.tables import CHECK, TableRecord, read_table

__all__ = ["check_same", "known_by", "resumed"]


def check_same(
    path: Path, record: TableRecord, columns: Sequence[str], expected: Mapping[str, Any]
) -> None:
    """Refuse to resume another study.

    Parameters
    ----------
    path : Path
        Where the table is, to begin the line with.
    record : TableRecord
        The table.
    columns : sequence of str
        Names of the numbers that a task returns.
    expected : dict
        What the table has to say of itself.

    Raises
    ------
    InputError
        If it is a table of something else, or says anything else.
    """
    stored, contents = record.meta.get("contents"), expected["contents"]
    named, history = ["task", *columns, "message"], record.meta.get("resumed", [])
    whole = isinstance(history, list) and all(
        isinstance(each, dict) and "versions" in each for each in history
    )
    found = list(record.columns)
    if not isinstance(stored, dict) or not whole or found != [*named, CHECK]:
        if found == named:
            raise InputError(
                f"{path}: got rows without checks, as earlier versions wrote them, expected a "
                "check in each: write elsewhere, or overwrite"
            )
        raise InputError(
            f"{path}: got a table of something else, expected one of this study: write elsewhere"
        )
    changed = [name for name in contents if stored.get(name) != contents[name]] or [
        name for name in ("study", "seed", "method") if record.meta.get(name) != expected.get(name)
    ]
    if changed:
        raise InputError(
            f"{path}: holds a study with another {', '.join(changed)}, expected the same: write "
            "elsewhere, or overwrite"
        )


def resumed(record: TableRecord, now: Mapping[str, Any]) -> dict[str, Any]:
    """What a table says of itself while it is resumed: the versions of its beginning, and today's.

    Parameters
    ----------
    record : TableRecord
    now : dict
        What a new table would say.

    Returns
    -------
    dict
        `resumed` lists from which row on, counted from 0, there are which other versions.
    """
    meta = {**record.meta, "replicates": now.get("replicates")}
    history: list[Any] = [*record.meta.get("resumed", [])]
    if now["versions"] != (history[-1] if history else meta).get("versions"):
        history.append({"row": record.columns["task"].size, "versions": now["versions"]})
        meta["resumed"] = history
    return meta


def known_by(path: Path) -> str:
    """What the study in a table is known by: a hash of all that its answers depend on.

    Parameters
    ----------
    path : Path

    Returns
    -------
    str
        32 hexadecimal digits.

    Raises
    ------
    InputError
        If there is no such table.
    """
    contents = read_table(path).meta.get("contents")
    text = json.dumps(contents, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]

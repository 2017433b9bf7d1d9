"""Tables of studies: every row is what was written, once; what the machine lost is done again."""

import re
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_analysis_study import levels, lines

from bayesfred.analysis import executor
from bayesfred.analysis.executor import run
from bayesfred.errors import InputError
from bayesfred.io import tables
from bayesfred.io.tables import TableRecord, appending, require_checks, write_table


class Squares:
    """A study of the numbers' squares; some tasks fail."""

    columns = ("x", "square")

    def __init__(self, failing: dict[int, Exception] | None = None, seed: int = 1) -> None:
        self.failing, self.seed = failing or {}, seed

    def contents(self) -> dict[str, str]:
        return {"what": "squares", "seed": str(self.seed)}

    def task(self, k: int) -> Sequence[float]:
        if k in self.failing:
            raise self.failing[k]
        return (k / 7, (k / 7) ** 2)


def squares(path: Path, n: int = 6, study: Squares | None = None, **options: Any) -> TableRecord:
    how: dict[str, Any] = {
        "executor": None, "workers": 1, "resume": False, "overwrite": False, "progress": False,
        **options,
    }  # fmt: skip
    study = study or Squares()
    meta = {"study": "squares", "seed": study.seed, "method": "exact", "replicates": n}
    return run(study, n, path=path, meta=meta, **how)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    squares(tmp_path / "s.ecsv")
    return tmp_path / "s.ecsv"


def edit(path: Path, change: Callable[[list[str]], None]) -> None:
    """Change a table's lines."""
    text = path.read_text(encoding="utf-8").split("\n")
    change(text)
    path.write_text("\n".join(text), encoding="utf-8")


def at(path: Path, task: int) -> int:
    """The index of a task's line."""
    text = path.read_text(encoding="utf-8").split("\n")
    return next(k for k, line in enumerate(text) if line.startswith(f"{task},"))


def test_rows_have_checks_that_their_reader_does_not_see(path: Path) -> None:
    found = tables.read_table(path)
    assert list(found.columns) == ["task", "x", "square", "message", "check"]
    assert len(set(found.columns["check"])) == 6
    again = squares(path, resume=True)
    assert list(again.columns) == ["task", "x", "square", "message"]
    assert again.columns["square"].tolist() == [(k / 7) ** 2 for k in range(6)]


def replaced(task: int, old: str, new: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        k = at(path, task)

        def swap(text: list[str]) -> None:
            assert old in text[k]
            text[k] = text[k].replace(old, new, 1)

        edit(path, swap)

    return change


def duplicated(path: Path) -> None:
    k = at(path, 2)
    edit(path, lambda text: text.insert(-1, text[k]))


def another_task(path: Path) -> None:
    """The row of task 2 as one of task 6."""
    replaced(2, "2,", "6,")(path)


def commented(path: Path) -> None:
    replaced(3, "3,", "# 3,")(path)


def blank(path: Path) -> None:
    k = at(path, 3)
    edit(path, lambda text: text.insert(k, ""))


def foreign(path: Path) -> None:
    """A row of a study with another seed."""
    other = path.with_name("other.ecsv")
    squares(other, study=Squares(seed=2))
    row = other.read_text(encoding="utf-8").split("\n")[at(other, 4)]
    k = at(path, 4)
    edit(path, lambda text: text.__setitem__(k, row))


def unchecked(path: Path) -> None:
    k = at(path, 4)
    edit(path, lambda text: text.__setitem__(k, text[k].rpartition(",")[0] + ',""'))


def hidden(path: Path) -> None:
    """A second row behind a character that some readers take for the end of a line."""
    replaced(4, "4,", "4,\u2028")(path)


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "a digit": (replaced(1, "0.14285714285714285", "0.14285714285714286"), "its check"),
    "a message": (replaced(1, '""', '"failed"'), "its check|damaged"),
    "a row twice": (duplicated, "the row of line"),
    "another task": (another_task, "its check"),
    "a row as a comment": (commented, "its check"),
    "a blank line": (blank, "its check"),
    "a row of another study": (foreign, "its check"),
    "no check": (unchecked, "its check"),
    "half a row": (replaced(3, "0.42857142857142855,", ""), "its check|damaged"),
    "a line end that is none": (hidden, "its check|damaged"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_row_that_is_not_as_it_was_written_is_refused_with_its_line(
    path: Path, fault: str
) -> None:
    change, words = FAULTS[fault]
    change(path)
    before = path.read_bytes()
    with pytest.raises(InputError, match=words) as refused:
        squares(path, 8, resume=True)
    assert path.read_bytes() == before
    text = str(refused.value)
    assert "\n" not in text
    if "damaged" not in text:
        line = int(text.partition(": line ")[2].partition(":")[0])
        assert 2 < line <= len(before.decode().split("\n"))


def test_the_line_is_the_one_that_an_editor_shows(path: Path) -> None:
    k = at(path, 3)
    replaced(3, "3,0.428", "3,0.429")(path)
    with pytest.raises(InputError, match=rf"s.ecsv: line {k + 1}: "):
        squares(path, resume=True)
    edit(path, lambda text: text.pop(k))
    assert squares(path, resume=True).columns["x"][3] == 3 / 7  # done again
    duplicated(path)
    last = len(path.read_text(encoding="utf-8").split("\n")) - 1
    with pytest.raises(InputError, match=rf"line {last}: got the row of line {at(path, 2) + 1} "):
        squares(path, resume=True)


def test_what_a_table_says_of_itself_is_compared(path: Path) -> None:
    before = path.read_text(encoding="utf-8")
    after = re.sub(r"\bseed: 1\b", "seed: 2", before)
    assert after != before
    path.write_text(after, encoding="utf-8")
    with pytest.raises(InputError, match="another seed"):
        squares(path, resume=True)


def test_tables_without_checks_are_read_but_not_resumed(path: Path) -> None:
    """As earlier versions wrote them."""
    found = tables.read_table(path)
    columns = {name: values for name, values in found.columns.items() if name != "check"}
    write_table(path, TableRecord(columns, found.meta), overwrite=True)
    assert tables.read_table(path).columns["x"].size == 6
    with pytest.raises(InputError, match="rows without checks, as earlier versions"):
        squares(path, resume=True)


def test_a_table_that_says_nothing_of_versions_is_refused_or_resumed(path: Path) -> None:
    found = tables.read_table(path)
    text = tables.read_text(path)
    for history in ("nonsense", [1], [{"row": 3}]):
        meta = {**found.meta, "resumed": history}
        tables.with_meta(path, text, TableRecord(found.columns, meta))
        with pytest.raises(InputError, match="something else"):
            squares(path, 8, resume=True)
    meta = {name: value for name, value in found.meta.items() if name != "versions"}
    tables.with_meta(path, text, TableRecord(found.columns, meta))
    assert squares(path, 8, resume=True).columns["task"].size == 8


def test_what_the_machine_lost_is_done_again(tmp_path: Path) -> None:
    """Memory and the system; a task that fails by what it works on is not."""
    path, whole = tmp_path / "s.ecsv", tmp_path / "whole.ecsv"
    wrong = {1: ValueError("of its own"), 2: MemoryError(), 4: OSError(24, "Too many open files")}
    with pytest.raises(InputError, match=r"s.ecsv: 2 of 6 tasks failed by no fault .*resume"):
        squares(path, study=Squares(wrong))
    assert [int(row.split(",")[0]) for row in lines(path)] == [0, 1, 3, 5]
    again = squares(path, resume=True)
    assert again.columns["message"].tolist() == ["", "ValueError: of its own", "", "", "", ""]
    squares(whole, study=Squares({1: wrong[1]}))
    assert lines(path) == lines(whole)


def test_a_real_study_is_resumed_after_a_lack_of_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, whole = tmp_path / "n.ecsv", tmp_path / "whole.ecsv"

    class Full:
        """An executor whose second task finds no memory."""

        def __init__(self) -> None:
            self.sent = 0

        def submit(self, function: Callable[..., Any], /, *args: Any) -> Future[Any]:
            self.sent += 1
            future: Future[Any] = Future()
            with monkeypatch.context() as patch:
                if self.sent == 2:
                    patch.setattr(
                        "bayesfred.analysis.noise_study.maximum",
                        lambda posterior: np.empty(2**50, np.float64),
                    )
                future.set_result(function(*args))
            return future

    with pytest.raises(InputError, match=r"1 of 6 tasks failed .*Unable to allocate"):
        levels(path, executor=Full())
    assert len(lines(path)) == 5
    levels(path, resume=True)
    levels(whole)
    assert lines(path) == lines(whole)


def test_the_versions_of_every_row_are_kept(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, first = lines(path), tables.read_table(path).meta["versions"]
    squares(path, resume=True)
    assert "resumed" not in tables.read_table(path).meta
    for n, version in ((8, "9.9"), (9, "9.9"), (10, "10.0")):
        monkeypatch.setattr(executor, "versions", lambda version=version: {"numpy": version})
        squares(path, n, resume=True)
    squares(path, 10, resume=True)
    meta = tables.read_table(path).meta
    assert (meta["versions"], meta["replicates"]) == (first, 10)
    assert meta["resumed"] == [
        {"row": 6, "versions": {"numpy": "9.9"}}, {"row": 9, "versions": {"numpy": "10.0"}}
    ]  # fmt: skip
    assert lines(path)[:6] == rows and len(lines(path)) == 10


def test_random_bytes_never_become_results(path: Path) -> None:
    """One byte of 600 changed at random below the header: the rows are the same, or refused."""
    rng, whole = np.random.default_rng(1), path.read_bytes()
    expected = squares(path, resume=True).columns
    below = whole.index(b"\n0,") + 1
    refused = 0
    for _ in range(600):
        k = int(rng.integers(below, len(whole)))
        path.write_bytes(whole[:k] + bytes([rng.integers(256)]) + whole[k + 1 :])
        try:
            found = squares(path, resume=True).columns
        except InputError:
            refused += 1
            continue
        assert all(np.array_equal(found[name], expected[name]) for name in expected)
    assert refused > 500


def test_checks_of_plain_tables(tmp_path: Path) -> None:
    path = tmp_path / "t.ecsv"
    columns = {"n": np.empty(0, np.int64), "word": np.empty(0, "U1"), "check": np.empty(0, "U1")}
    write_table(path, TableRecord(columns, {}))
    with appending(path, "key") as append:
        append([1, 'a, "b"\n'])
        append([2, ""])
    text = tables.read_text(path)
    require_checks(path, text, "key")
    with pytest.raises(InputError, match="line"):
        require_checks(path, text, "another key")
    assert tables.parse(path, text).columns["word"].tolist() == ["a, 'b'\\n", ""]

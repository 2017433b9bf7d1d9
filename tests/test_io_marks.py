"""Marks: a run knows its own files, whatever their format, and takes no other for one."""

import io
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from matplotlib.figure import Figure
from PIL import Image

from bayesfred.errors import InputError
from bayesfred.io.marks import marked, may_replace
from bayesfred.io.psf_images import read_psf, write_psf
from bayesfred.io.tables import TableRecord, read_table, write_table
from bayesfred.reporting.style import png

RUN, OTHER = "0123456789abcdef" * 2, "f" * 32
PAGE = b"<!DOCTYPE html>\n<html lang=en><title>run</title></html>\n"
NAMES = ("run.html", "run.png", "run.sources.ecsv", "run.psf.fits")
NUMBERS = {
    "oversampling": 4, "field_radius": 1.0, "determined": 3.0, "model_error": 0.01, "nodes": 0,
}  # fmt: skip


def make(folder: Path, run: str = RUN) -> list[Path]:
    """A file of every format, marked."""
    paths = [folder / name for name in NAMES]
    paths[0].write_bytes(marked(PAGE, run))
    paths[1].write_bytes(marked(png(Figure(figsize=(1, 1))), run))
    columns = {"x": np.array([0.1, np.nan]), "word": np.array(["", "a, 'b'"])}
    write_table(paths[2], TableRecord(columns, {"seed": 1, "note": "a: b"}), run=run)
    arrays = {"coefficients": np.random.default_rng(1).random((1, 7, 7)), "draws": None}
    write_psf(paths[3], np.ones((9, 9)), arrays, NUMBERS, run=run)
    return paths


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    return make(tmp_path)


def owned(path: Path, run: str = RUN) -> bool:
    try:
        may_replace(run, path)
    except InputError as error:
        return not str(error).startswith(f"{path}: exists, and is not as this run wrote it")
    return True


def test_a_run_knows_its_own_files(paths: list[Path], tmp_path: Path) -> None:
    assert [owned(path) for path in paths] == [True] * 4
    assert [owned(path, OTHER) for path in paths] == [False] * 4
    assert owned(tmp_path / "absent.html")
    may_replace(RUN, *paths)
    moved = paths[0].rename(tmp_path / "elsewhere.html")
    assert owned(moved)


def test_marked_files_are_read_as_before(paths: list[Path]) -> None:
    assert paths[0].read_bytes().startswith(PAGE)
    with Image.open(paths[1]) as image:
        image.load()
        assert image.info["Source"].startswith(f"bayesfred run {RUN} content ")
        plain = Image.open(io.BytesIO(png(Figure(figsize=(1, 1)))))
        assert image.tobytes() == plain.tobytes()
    record, table = read_table(paths[2]), Table.read(paths[2])
    assert record.meta == dict(table.meta) == {"seed": 1, "note": "a: b"}
    assert record.columns["word"].tolist() == ["", "a, 'b'"]
    assert read_psf(paths[3])["oversampling"] == 4.0
    with fits.open(paths[3], checksum=True) as file:
        assert file[0].header["BFRUN"] == RUN and "COEFFICIENTS" in file


def test_a_file_that_was_edited_is_not_the_run_s_any_more(paths: list[Path]) -> None:
    for path in paths[:3]:
        content = path.read_bytes()
        path.write_bytes(content + b"\n<p>my notes</p>\n")
        assert not owned(path)
        path.write_bytes(content)
        assert owned(path)
    with fits.open(paths[3]) as file:
        file[0].header["OBSERVER"] = "me"
        file.writeto(paths[3], overwrite=True, checksum=True)
    assert not owned(paths[3])


@pytest.mark.parametrize("k", range(4))
def test_every_changed_byte_is_seen(paths: list[Path], k: int) -> None:
    """200 bytes at random. Of a FITS file the checksums, and the time of writing, are not its own.

    A blank that became a line of blanks' end is no content there either, so it is left out.
    """
    path, rng = paths[k], np.random.default_rng(2)
    content = path.read_bytes()
    for _ in range(200):
        at = int(rng.integers(len(content)))
        card = content[at // 80 * 80 : at // 80 * 80 + 80]
        if k == 3 and card.startswith((b"CHECKSUM", b"DATASUM")):
            continue
        path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        assert not owned(path), at
    for cut in rng.integers(len(content), size=50):
        path.write_bytes(content[:cut])
        assert not owned(path), cut


def test_what_is_no_file_of_a_run_is_not_taken_for_one(paths: list[Path], tmp_path: Path) -> None:
    for content in (
        b"",
        b"mine",
        PAGE,
        b"\x89PNG\r\n\x1a\n",
        b"# %ECSV 1.0\n# ---\n",
        b"SIMPLE  =",
    ):
        paths[0].write_bytes(content)
        assert not owned(paths[0]), content
    (tmp_path / "folder.html").mkdir()
    (tmp_path / "link.html").symlink_to("nowhere")
    assert not owned(tmp_path / "folder.html") and not owned(tmp_path / "link.html")


def test_another_run_s_mark_on_my_content_is_no_mark(paths: list[Path]) -> None:
    """A mark that was copied with its hash holds for the content that it came with alone."""
    line = paths[0].read_bytes()[len(PAGE) :]
    paths[0].write_bytes(b"<html>mine</html>\n" + line)
    assert not owned(paths[0])
    paths[0].write_bytes(PAGE + line)
    assert owned(paths[0])

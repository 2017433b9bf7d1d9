"""Frames and catalogues: what is read and written, and what is refused in one line."""

from __future__ import annotations

import gzip
import os
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import MaskedColumn, Table

from bayesfred.errors import InputError
from bayesfred.io.atomic import replace
from bayesfred.io.catalogues import CatalogueRecord, read_catalogue, write_catalogue
from bayesfred.io.frames import read_frame, write_frame
from bayesfred.io.lock import only_writer
from bayesfred.io.paths import may_write
from bayesfred.io.tables import read_table
from bayesfred.sampling.chainfile import open_chain
from bayesfred.settings.run import read_settings

COUNTS = np.arange(35.0).reshape(5, 7)
FRAME_SUFFIXES = [".fits", ".fit", ".FTS", ".fits.gz", ".fits.fz", ".h5", ".hdf5", ".npy"]
DATA = Path(os.environ.get("BAYESFRED_DATA") or Path(__file__).parents[2] / "shared" / "data")
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"the real frames are not at {DATA}")


def message(call: Callable[..., Any], *args: Any, **keywords: Any) -> str:
    """Return the one line with which a call refuses its input."""
    with pytest.raises(InputError) as caught:
        call(*args, **keywords)
    text = str(caught.value)
    assert "\n" not in text
    return text


def csv(folder: Path, text: str, name: str = "stars.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode())
    return path


# Frames


@pytest.mark.parametrize("suffix", FRAME_SUFFIXES)
def test_frame_round_trip(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"frame{suffix}"
    write_frame(path, COUNTS)
    frame = read_frame(path)
    np.testing.assert_array_equal(frame.counts, COUNTS)
    assert frame.counts.dtype == np.float64
    assert frame.counts.dtype.isnative
    assert frame.valid.all()
    assert frame.n_masked == 0
    assert frame.description == f"frame{suffix}: 5 x 7 pixels, none masked"
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", FRAME_SUFFIXES)
def test_frame_keeps_every_bit(tmp_path: Path, suffix: str) -> None:
    image = np.random.default_rng(1).normal(size=(40, 30)) * 1e3
    write_frame(tmp_path / f"frame{suffix}", image)
    np.testing.assert_array_equal(read_frame(tmp_path / f"frame{suffix}", gain=1.0).counts, image)


@pytest.mark.parametrize(
    "dtype", [np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.int64, np.float32, ">f8"]
)
@pytest.mark.parametrize("suffix", [".fits", ".h5", ".npy"])
def test_stored_types(tmp_path: Path, dtype: Any, suffix: str) -> None:
    path, stored = tmp_path / f"frame{suffix}", COUNTS.astype(dtype)
    if suffix == ".fits":
        fits.PrimaryHDU(stored).writeto(path)
    elif suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["counts"] = stored
    else:
        np.save(path, stored)
    np.testing.assert_array_equal(read_frame(path).counts, COUNTS)


def test_gain_and_pedestal(tmp_path: Path) -> None:
    write_frame(tmp_path / "frame.npy", [[100.5, 96.0], [103.0, 110.0]])
    frame = read_frame(tmp_path / "frame.npy", gain=2.0, pedestal=100.0)
    np.testing.assert_allclose(frame.counts, [[1.0, -8.0], [6.0, 20.0]], rtol=1e-15)


def test_pedestal_without_gain_leaves_counts(tmp_path: Path) -> None:
    write_frame(tmp_path / "frame.npy", [[10.0, 12.0]])
    np.testing.assert_array_equal(
        read_frame(tmp_path / "frame.npy", pedestal=10.0).counts, [[0.0, 2.0]]
    )
    assert "got -1 at row 0, column 0" in message(read_frame, tmp_path / "frame.npy", pedestal=11.0)


def test_bad_pixels_are_masked_and_named(tmp_path: Path) -> None:
    image = COUNTS.copy()
    image[0, :3], image[1, 2], image[4, 3:] = np.nan, -np.inf, 70.5
    write_frame(tmp_path / "frame.fits", image)
    frame = read_frame(tmp_path / "frame.fits", saturation=70.5)
    bad = np.zeros(image.shape, dtype=bool)
    bad[0, :3] = bad[1, 2] = bad[4, 3:] = True
    np.testing.assert_array_equal(frame.valid, ~bad)
    np.testing.assert_array_equal(frame.counts, np.where(bad, 0.0, COUNTS))
    assert frame.n_masked == 8
    assert (
        frame.description == "frame.fits: 5 x 7 pixels, 8 masked (3 NaN, 1 infinite, 4 saturated)"
    )


def test_saturation_is_in_stored_units(tmp_path: Path) -> None:
    write_frame(tmp_path / "frame.npy", [[9.0, 10.0]])
    frame = read_frame(tmp_path / "frame.npy", gain=100.0, pedestal=5.0, saturation=10.0)
    np.testing.assert_array_equal(frame.valid, [[True, False]])


def test_counts_up_to_rounding(tmp_path: Path) -> None:
    write_frame(tmp_path / "frame.npy", [[3.0 + 1e-10, -1e-10]])
    counts = read_frame(tmp_path / "frame.npy").counts
    np.testing.assert_array_equal(counts, [[3.0, 0.0]])
    assert not np.signbit(counts).any()


@pytest.mark.parametrize(
    ("value", "shown"), [(2.5, "2.5"), (-3.0, "-3"), (1.0 + 1e-8, "1.00000001")]
)
def test_numbers_that_are_not_counts(tmp_path: Path, value: float, shown: str) -> None:
    image = COUNTS.copy()
    image[2, 4] = value
    image[3, 1] = 0.5
    write_frame(tmp_path / "frame.fits", image)
    text = message(read_frame, tmp_path / "frame.fits")
    assert text.startswith(
        f"{tmp_path / 'frame.fits'}: got {shown} at row 2, column 4, expected counts"
    )
    assert text.endswith("give gain (e-/adu) and pedestal")


def test_first_image_or_the_named_one(tmp_path: Path) -> None:
    path = tmp_path / "frame.fits"
    table = fits.BinTableHDU(Table({"a": [1]}))
    cube, first = fits.ImageHDU(np.zeros((2, 3, 4)), name="CUBE"), fits.ImageHDU(COUNTS, name="SCI")
    second = fits.ImageHDU(COUNTS + 1, name="OTHER")
    fits.HDUList([fits.PrimaryHDU(), table, cube, first, second]).writeto(path)
    np.testing.assert_array_equal(read_frame(path).counts, COUNTS)
    np.testing.assert_array_equal(read_frame(path, name="other").counts, COUNTS + 1)
    assert "CUBE 2 x 3 x 4, SCI 5 x 7" in message(read_frame, path, name="nope")
    assert "expected a 2-D image in extension 'cube'" in message(read_frame, path, name="cube")


def test_bscale_bzero_and_blank(tmp_path: Path) -> None:
    scaled = fits.PrimaryHDU(COUNTS.copy())
    scaled.scale("int16", bscale=0.5, bzero=10.0)
    scaled.writeto(tmp_path / "scaled.fits")
    np.testing.assert_array_equal(read_frame(tmp_path / "scaled.fits").counts, COUNTS)
    blank = fits.PrimaryHDU(np.arange(-32768, -32762, dtype=np.int16).reshape(2, 3))
    blank.header.update({"BSCALE": 1, "BZERO": 32768, "BLANK": -32764})
    blank.writeto(tmp_path / "blank.fits")
    frame = read_frame(tmp_path / "blank.fits")
    np.testing.assert_array_equal(frame.counts, [[0, 1, 2], [3, 0, 5]])
    np.testing.assert_array_equal(frame.valid, [[True] * 3, [True, False, True]])


def test_hdf5_dataset_by_name(tmp_path: Path) -> None:
    path = tmp_path / "frame.h5"
    with h5py.File(path, "w") as file:
        file["night/one"] = COUNTS
        file["text"] = "a"
        file["line"] = COUNTS[0]
    np.testing.assert_array_equal(read_frame(path, name="night/one").counts, COUNTS)
    assert "got no dataset 'counts', expected one of: 'line', 'night', 'text'" in message(
        read_frame, path
    )
    assert "got no dataset 'night'" in message(read_frame, path, name="night")
    assert "line: got an array of 7, expected a 2-D image" in message(read_frame, path, name="line")
    assert "text: got no array, expected a 2-D image" in message(read_frame, path, name="text")


@pytest.mark.parametrize(
    ("keywords", "expected"),
    [
        ({"gain": 0.0}, "gain: got 0.0, expected a positive number"),
        ({"gain": np.inf}, "gain: got inf"),
        ({"pedestal": np.nan}, "pedestal: got nan, expected a finite number"),
        ({"saturation": np.nan}, "saturation: got nan, expected a level in stored units"),
        ({"saturation": 0.0}, "got every pixel masked (35 saturated), expected some"),
        ({"name": "counts"}, "got name 'counts', expected none"),
    ],
)
def test_frame_options_refused(tmp_path: Path, keywords: dict[str, Any], expected: str) -> None:
    write_frame(tmp_path / "frame.npy", COUNTS)
    text = message(read_frame, tmp_path / "frame.npy", **keywords)
    assert text.startswith(f"{tmp_path / 'frame.npy'}: ")
    assert expected in text


@pytest.mark.parametrize("suffix", [".fits", ".fits.gz", ".fits.fz", ".h5", ".npy"])
@pytest.mark.parametrize("damage", ["empty", "text", "cut in the heading", "cut in the data"])
def test_damaged_frames(tmp_path: Path, suffix: str, damage: str) -> None:
    path = tmp_path / f"frame{suffix}"
    write_frame(path, np.random.default_rng(1).poisson(100.0, (100, 100)))
    whole = path.read_bytes()
    kept = {"empty": 0, "cut in the heading": 100, "cut in the data": len(whole) // 2}
    path.write_bytes(b"not a frame\n" * 1000 if damage == "text" else whole[: kept[damage]])
    assert message(read_frame, path).startswith(f"{path}: damaged or no ")


def test_damaged_fits_headings(tmp_path: Path) -> None:
    write_frame(tmp_path / "frame.fits", COUNTS)
    whole = (tmp_path / "frame.fits").read_bytes()
    for value in ("'abc'", "-7", "30000000000000000"):
        start = whole.index(b"NAXIS1")
        card = f"NAXIS1  = {value:>20}".ljust(80).encode()
        path = tmp_path / "damaged.fits"
        path.write_bytes(whole[:start] + card + whole[start + 80 :])
        assert str(path) in message(read_frame, path)
    (tmp_path / "flipped.fits.gz").write_bytes(gzip.compress(whole)[:-8] + bytes(8))
    assert "damaged" in message(read_frame, tmp_path / "flipped.fits.gz")


def huge(folder: Path, suffix: str) -> Path:
    """A small file whose image claims more pixels than memory holds."""
    path = folder / f"frame{suffix}"
    if suffix == ".h5":
        with h5py.File(path, "w") as file:
            file.create_dataset("counts", (10**6, 10**6), "f8", chunks=(1000, 1000))
        return path
    if suffix == ".fits.fz":
        packed = fits.CompImageHDU(COUNTS, quantize_level=0.0)
        fits.HDUList([fits.PrimaryHDU(), packed]).writeto(path)
        content, cards = path.read_bytes(), (b"ZNAXIS1 =", b"ZNAXIS2 =")
    else:
        write_frame(folder / "small.fits", COUNTS)
        content, cards = (folder / "small.fits").read_bytes(), (b"NAXIS1  =", b"NAXIS2  =")
    for card in cards:
        start = content.index(card)
        content = content[:start] + card + f"{10**6:>21}".encode() + content[start + 30 :]
    path.write_bytes(gzip.compress(content) if suffix == ".fits.gz" else content)
    return path


@pytest.mark.parametrize("suffix", [".fits", ".fits.gz", ".fits.fz", ".h5"])
def test_frames_larger_than_memory_are_refused_unread(tmp_path: Path, suffix: str) -> None:
    path = huge(tmp_path, suffix)
    text = message(read_frame, path)
    assert text.startswith(f"{path}: ")
    need = float(
        re.search(r"got 1000000 x 1000000 pixels, whose fit would need about (\S+) GB", text)[1]
    )  # type: ignore[index]
    assert need == pytest.approx(1e12 * (150 + 24 * (os.cpu_count() or 1)) / 1e9, rel=0.01)
    assert text.endswith("GB that this process may take: cut the frame or bin it")


def test_memory_is_asked_before_data_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine may have room for the bytes of a frame but not for its fit."""
    monkeypatch.setattr(os, "sysconf", {"SC_PHYS_PAGES": 10, "SC_PAGE_SIZE": 100}.__getitem__)
    for suffix in FRAME_SUFFIXES:
        write_frame(tmp_path / f"frame{suffix}", COUNTS)
        assert "got 5 x 7 pixels, whose fit would need about" in message(
            read_frame, tmp_path / f"frame{suffix}"
        )


@pytest.mark.parametrize("kind", ["external storage", "external link", "virtual dataset"])
def test_hdf5_frames_kept_elsewhere(tmp_path: Path, kind: str) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["counts"] = COUNTS
    with h5py.File(tmp_path / "frame.h5", "w") as file:
        if kind == "external storage":
            file.create_dataset(
                "counts",
                COUNTS.shape,
                "f8",
                external=[(str(tmp_path / "other.h5"), 0, h5py.h5f.UNLIMITED)],
            )
        elif kind == "external link":
            file["counts"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "counts")
        else:
            layout = h5py.VirtualLayout(COUNTS.shape, "f8")
            layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "counts", COUNTS.shape)
            file.create_virtual_dataset("counts", layout)
    assert "frame.h5: counts: got a dataset kept in another file" in message(
        read_frame, tmp_path / "frame.h5"
    )


def test_counts_beyond_float64(tmp_path: Path) -> None:
    write_frame(tmp_path / "frame.npy", [[2.0**53, 1e308]])
    assert "got 1e+308 at row 0, column 1, expected counts of at most 9e+15" in message(
        read_frame, tmp_path / "frame.npy"
    )
    with_gain = message(read_frame, tmp_path / "frame.npy", gain=10.0)  # the second pixel overflows
    assert "got 9.00719925e+16 at row 0, column 0" in with_gain
    assert "got inf at row 0, column 1" in message(
        read_frame, tmp_path / "frame.npy", gain=100.0, pedestal=2.0**53
    )
    frame = read_frame(tmp_path / "frame.npy", saturation=1e300)
    np.testing.assert_array_equal(frame.counts, [[2.0**53, 0.0]])


def test_odd_headings_are_read_in_silence(tmp_path: Path) -> None:
    path = tmp_path / "frame.fits"
    write_frame(path, COUNTS)
    whole = path.read_bytes()
    path.write_bytes(
        whole.replace(b"EXTEND ", b"EXT\xe9ND ")[: 2880 + COUNTS.nbytes]
    )  # and no padding at the end
    np.testing.assert_array_equal(read_frame(path).counts, COUNTS)


def test_npy_is_never_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "frame.npy", np.array([[{}, {}]], dtype=object), allow_pickle=True)
    assert "damaged or no NPY" in message(read_frame, tmp_path / "frame.npy")


@pytest.mark.parametrize("shape", [(7,), (2, 3, 4), (0, 4)])
@pytest.mark.parametrize("suffix", [".npy", ".h5", ".fits"])
def test_frames_of_other_dimensions(tmp_path: Path, shape: tuple[int, ...], suffix: str) -> None:
    path, image = tmp_path / f"frame{suffix}", np.zeros(shape)
    if suffix == ".npy":
        np.save(path, image)
    elif suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["counts"] = image
    else:
        fits.PrimaryHDU(image).writeto(path)
    text = message(read_frame, path)
    assert " x ".join(map(str, shape)) in text
    assert "2-D image" in text


def test_frames_of_other_types(tmp_path: Path) -> None:
    np.save(tmp_path / "frame.npy", COUNTS + 1j)
    assert "got values of type complex128, expected real" in message(
        read_frame, tmp_path / "frame.npy"
    )
    assert "2-D image" in message(write_frame, tmp_path / "new.npy", [1.0, 2.0])
    assert "expected real" in message(write_frame, tmp_path / "new.npy", [["a"]])


@pytest.mark.parametrize("name", ["frame.jpg", "frame", "frame.gz", "frame.npy.gz", "frame.h5.fz"])
def test_frame_suffixes_refused(tmp_path: Path, name: str) -> None:
    for call in (
        message(read_frame, tmp_path / name),
        message(write_frame, tmp_path / name, COUNTS),
    ):
        assert call.startswith(f"{tmp_path / name}: got a frame file ending in ")
        assert ".fits .fit .fts .h5 .hdf5 .npy" in call


def test_missing_files(tmp_path: Path) -> None:
    (tmp_path / "folder.fits").mkdir()
    assert f"{tmp_path / 'no.fits'}: no such file" in message(read_frame, tmp_path / "no.fits")
    assert "folder.fits: not a file" in message(read_frame, tmp_path / "folder.fits")
    assert f"{tmp_path / 'no.csv'}: no such file" in message(read_catalogue, tmp_path / "no.csv")


# Writing


@pytest.fixture
def pipe(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Makes pipes that nobody writes to; reading one ends the test."""

    def make(name: str) -> Path:
        os.mkfifo(tmp_path / name)
        return tmp_path / name

    def fail(*_: object) -> None:
        raise AssertionError("waits for a pipe")

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(5)
    yield make
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("name", ["a.fits", "a.fits.gz", "a.fits.fz", "a.h5", "a.npy", "a.png"])
def test_a_pipe_is_no_frame(pipe: Callable[[str], Path], name: str) -> None:
    assert "not a file" in message(read_frame, pipe(name))


def test_a_pipe_is_no_other_input(pipe: Callable[[str], Path]) -> None:
    assert "not a file" in message(read_catalogue, pipe("stars.csv"))
    assert "not a file" in message(read_table, pipe("table.ecsv"))
    assert "not a file" in message(read_settings, pipe("run.toml"))
    assert "no such file" in message(open_chain, pipe("run.h5"))


def test_a_pipe_does_not_keep_a_second_writer_waiting(
    pipe: Callable[[str], Path], tmp_path: Path
) -> None:
    with only_writer(tmp_path / "run.h5"):
        (tmp_path / ".run.h5.writer").unlink()
        pipe(".run.h5.writer")
        said = pytest.raises(InputError, match="another process is writing this chain, expected")
        with said, only_writer(tmp_path / "run.h5"):
            pass


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    stars = CatalogueRecord(*np.ones((3, 1)))
    write_frame(tmp_path / "frame.fits", COUNTS)
    write_catalogue(tmp_path / "stars.csv", stars)
    before = (tmp_path / "frame.fits").read_bytes()
    assert "frame.fits: exists, expected a new file" in message(
        write_frame, tmp_path / "frame.fits", COUNTS + 1
    )
    assert "--overwrite" in message(write_catalogue, tmp_path / "stars.csv", stars)
    assert (tmp_path / "frame.fits").read_bytes() == before
    write_frame(tmp_path / "frame.fits", COUNTS + 1, overwrite=True)
    write_catalogue(tmp_path / "stars.csv", stars, overwrite=True)
    np.testing.assert_array_equal(read_frame(tmp_path / "frame.fits").counts, COUNTS + 1)


def test_links_are_replaced_and_not_followed(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("precious")
    for target in ("precious", "absent"):
        link = tmp_path / f"{target}.npy"
        link.symlink_to(target)
        assert "exists, expected a new file" in message(write_frame, link, COUNTS)
        write_frame(link, COUNTS, overwrite=True)
        assert not link.is_symlink()
    assert (tmp_path / "precious").read_text() == "precious"
    assert not (tmp_path / "absent").exists()


@pytest.mark.parametrize("name", ["x" * 1000 + ".npy", "zero\0byte.npy", "file/below.npy"])
def test_names_that_no_file_has(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    assert "no such file" in message(read_frame, tmp_path / name)


def test_a_write_that_fails_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_frame(tmp_path / "frame.npy", COUNTS)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    text = message(write_frame, tmp_path / "frame.npy", COUNTS + 1, overwrite=True)
    assert "frame.npy: cannot be written (No space left on device)" in text
    np.testing.assert_array_equal(read_frame(tmp_path / "frame.npy").counts, COUNTS)
    assert [entry.name for entry in tmp_path.iterdir()] == ["frame.npy"]


def test_folders_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in ("none", "file"):
        text = message(write_frame, tmp_path / folder / "frame.npy", COUNTS)
        assert "frame.npy: cannot be written (" in text


@pytest.mark.parametrize("sole_writer", [False, True])
def test_a_file_is_replaced_in_one_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sole_writer: bool
) -> None:
    done: list[str] = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, n=name, f=real: (done.append(n), f(*a))[1])
    path = tmp_path / "page.html"
    path.write_text("old")
    replace(path, b"ne", memoryview(b"w"), sole_writer=sole_writer)
    assert path.read_text() == "new"
    assert done == ["fsync", "replace", "fsync"]  # the file before, the folder after
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]


def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path: Path) -> None:
    left, other = tmp_path / ".page.html.tmp", tmp_path / ".page.html.0a1b2c3d.tmp"
    (tmp_path / "precious").write_text("precious")
    left.symlink_to("precious")
    other.write_text("of another writer, who is busy with it")
    replace(tmp_path / "page.html", b"new", sole_writer=True)
    assert not left.is_symlink() and other.exists()
    assert (tmp_path / "precious").read_text() == "precious"


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(1)])
def test_an_interrupted_write_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def interrupted(*_: object) -> None:
        raise error

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(type(error)):
        replace(tmp_path / "page.html", b"new")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["x" * 300, "zero\0byte", "file/below"])
def test_names_that_cannot_be_written(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    assert "cannot be written (" in message(replace, tmp_path / name, b"new")


def test_one_answer_to_a_file_that_exists(tmp_path: Path) -> None:
    run, page = tmp_path / "run.h5", tmp_path / "run.html"
    for resume in (None, False, True):
        assert may_write(run, overwrite=False, resume=resume, beside=[page]) is False
    page.touch()  # of another run: there is none to resume
    text = message(may_write, run, overwrite=False, resume=True, beside=[page])
    assert text.startswith(f"{page}: exists, expected a new file: write elsewhere, or replace it")
    assert may_write(run, overwrite=True, resume=False, beside=[page]) is False
    run.symlink_to("nowhere")  # a link that leads nowhere is something that exists, too
    assert may_write(run, overwrite=False, resume=True, beside=[page]) is True
    text = message(may_write, run, overwrite=False, resume=False, beside=[page])
    assert text.startswith(f"{run}: exists, expected a new file: resume it with --resume, or repl")
    assert "--resume" not in message(may_write, run, overwrite=False)
    assert "got both --resume and --overwrite" in message(
        may_write, run, overwrite=True, resume=True
    )


# Catalogues


@pytest.mark.parametrize("suffix", [".csv", ".ecsv", ".CSV"])
def test_catalogue_round_trip(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(1)
    stars = CatalogueRecord(
        rng.normal(size=9), rng.normal(size=9) * 1e-9, rng.exponential(size=9) * 1e7
    )
    write_catalogue(tmp_path / f"stars{suffix}", stars)
    back = read_catalogue(tmp_path / f"stars{suffix}")
    for name in ("x", "y", "flux"):
        np.testing.assert_array_equal(getattr(back, name), getattr(stars, name))
        assert getattr(back, name).dtype == np.float64
    assert [entry.name for entry in tmp_path.iterdir()] == [f"stars{suffix}"]


def test_columns_by_name(tmp_path: Path) -> None:
    path = csv(
        tmp_path,
        '\ufeffname,px, py,e\r\n\r\n"A, B",99999999999999999999999,-2.5,7\r\nC,3,4,5e3\r\n',
    )
    stars = read_catalogue(path, x="px", y="py", flux="e")
    np.testing.assert_array_equal(stars.x, [1e23, 3])
    np.testing.assert_array_equal(stars.y, [-2.5, 4])
    np.testing.assert_array_equal(stars.flux, [7, 5e3])


def test_magnitudes(tmp_path: Path) -> None:
    path = csv(tmp_path, "x,y,mag\n1,2,20\n3,4,17.5\n")
    stars = read_catalogue(path, magnitude="mag", zero_point=25.0)
    np.testing.assert_allclose(stars.flux, [100.0, 1000.0], rtol=1e-14)
    assert "zero_point: got None, expected a number" in message(
        read_catalogue, path, magnitude="mag"
    )
    text = message(read_catalogue, path, magnitude="mag", zero_point=1e6)
    assert "row 1, column 'mag': got a flux of inf, expected a positive" in text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "got an empty catalogue"),
        ("x,y,flux\n", "got an empty catalogue"),
        ("x,y,mag\n1,2,3\n", "got no column 'flux', expected one of: 'x', 'y', 'mag'"),
        ("x;y;flux\n1;2;3\n", "got no column 'x', expected one of: 'x;y;flux'"),
        ("x,y,flux\n1,2,3\n4,,6\n", "row 2, column 'y': got nothing, expected a finite number"),
        ("x,y,flux\n1,2,3\n4,5\n", "row 2, column 'flux': got nothing"),
        ("x,y,flux\n1,2,3\nA7,5,6\n", "row 2, column 'x': got 'A7', expected a finite number"),
        ("x,y,flux\n1,nan,3\n", "row 1, column 'y': got 'nan'"),
        ("x,y,flux\n1,2,1e999\n", "row 1, column 'flux': got 'inf'"),
        ("x,y,flux\nTrue,2,3\n", "row 1, column 'x': got 'True'"),
        ("x,y,flux\n1,2,3\n4,5,0\n", "row 2, column 'flux': got a flux of 0, expected a positive"),
        ("x,y,flux\n1,2,-3.5\n", "row 1, column 'flux': got a flux of -3.5, expected a positive"),
        ("x,y,flux\n1,2,3\n4,5,6\n1.0,2,7\n", "row 3: got position (1, 2) again, as in row 1"),
        ("x,y,flux\n1,2,3,4\n", "damaged or no table"),
        # A quotation mark left open must not swallow the rows behind it.
        ('x,y,flux\n1,2,3\n"4,5,6\n7,8,9\n', "row 2, column 'x': got '4,5,6"),
    ],
)
def test_catalogues_refused(tmp_path: Path, text: str, expected: str) -> None:
    path = csv(tmp_path, text)
    got = message(read_catalogue, path)
    assert got.startswith(f"{path}: ")
    assert expected in got


ECSV = """# %ECSV 1.0
# ---
# delimiter: ','
# datatype:
# - {name: x, datatype: float64}
# - {name: y, datatype: float64}
# - {name: flux, datatype: float64}
# - {name: id, datatype: string}
# schema: astropy-2.0
"""


@pytest.mark.parametrize("separator", [*"\x0b\x0c\x1c\x1d\x1e\x85\u2028\u2029"])
@pytest.mark.parametrize("suffix", [".csv", ".ecsv"])
def test_only_line_ends_end_a_row(tmp_path: Path, separator: str, suffix: str) -> None:
    """What follows such a character in a name was taken for a source of its own."""
    text = f"x,y,flux,id\n2,3,4,A{separator}9,8,7,B\n".replace("9,8,7,B", '"9,8,7,B"')
    quoted = f'x,y,flux,id\n2,3,4,"A{separator}9,8,7,B"\n'
    for rows in (text.replace('"', ""), quoted):
        path = csv(tmp_path, (ECSV if suffix == ".ecsv" else "") + rows, f"stars{suffix}")
        if rows == quoted:
            assert read_catalogue(path).x.tolist() == [2.0]
        else:
            assert "inconsistent with data columns (7)" in message(read_catalogue, path)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lines_end_as_any_system_ends_them(tmp_path: Path, end: str) -> None:
    path = csv(tmp_path, end.join(["x,y,flux", "1,2,3", "4,5,6", ""]))
    assert read_catalogue(path).x.tolist() == [1.0, 4.0]


@pytest.mark.parametrize("heading", ["x,y,flux,x", "x, y,flux, x ", "x,x,flux,y"])
@pytest.mark.parametrize("suffix", [".csv", ".ecsv"])
def test_columns_of_one_name_are_refused(tmp_path: Path, heading: str, suffix: str) -> None:
    """The first was taken, and nothing said."""
    text = f"{heading}\n1,2,3,4\n"
    if suffix == ".ecsv":
        names = [name.strip() for name in heading.split(",")]
        kinds = [f"# - {{name: {name}, datatype: float64}}" for name in names]
        text = "\n".join(["# %ECSV 1.0", "# ---", "# delimiter: ','", "# datatype:", *kinds,
                          "# schema: astropy-2.0", text])  # fmt: skip
    said = message(read_catalogue, csv(tmp_path, text, f"stars{suffix}"))
    assert "got column 'x' 2 times, expected it once" in said


def test_columns_of_one_name_that_are_not_used(tmp_path: Path) -> None:
    assert read_catalogue(csv(tmp_path, "id,x,y,flux,id\na,1,2,3,b\n")).x.tolist() == [1.0]


def test_catalogues_of_other_kinds(tmp_path: Path) -> None:
    assert "got a catalogue file ending in '.txt', expected .csv or .ecsv" in message(
        read_catalogue, csv(tmp_path, "x,y,flux\n1,2,3\n", "stars.txt")
    )
    assert "'.fits'" in message(
        write_catalogue, tmp_path / "stars.fits", CatalogueRecord(*np.ones((3, 1)))
    )
    assert "damaged or no table" in message(
        read_catalogue, csv(tmp_path, "x,y\n1,2\n", "stars.ecsv")
    )
    (tmp_path / "latin.csv").write_bytes(b"x,y,flux,n\n1,2,3,\xe9\n")
    assert "latin.csv: damaged or no table ('utf-8' codec" in message(
        read_catalogue, tmp_path / "latin.csv"
    )


def test_ecsv_columns(tmp_path: Path) -> None:
    path = tmp_path / "stars.ecsv"
    table = Table(
        {"x": [1.0, 2.0], "y": [3.0, 4.0], "flux": MaskedColumn([5.0, 6.0], mask=[False, True])}
    )
    table["deep"] = np.ones((2, 3))
    table.write(path, format="ascii.ecsv")
    assert "row 2, column 'flux': got nothing" in message(read_catalogue, path)
    assert "row 1, column 'deep'" in message(read_catalogue, path, flux="deep")
    np.testing.assert_array_equal(read_catalogue(path, flux="y").flux, [3.0, 4.0])


# Real frames


@needs_data
@pytest.mark.parametrize("name", ["startracker_alt40_azi135", "startracker_alt60_azi45"])
def test_star_tracker_frames(name: str) -> None:
    frame = read_frame(DATA / f"{name}.fits", gain=2.72, pedestal=-10.0, saturation=4095)
    with fits.open(DATA / f"{name}.fits") as hdus:
        stored = hdus[0].data.astype(np.float64)
    assert frame.counts.shape == (768, 1024)
    assert frame.n_masked == (stored >= 4095).sum()
    np.testing.assert_allclose(
        frame.counts[frame.valid], (stored[frame.valid] + 10) * 2.72, rtol=1e-14
    )
    assert "PEDESTAL: got -10 in the header" in message(read_frame, DATA / f"{name}.fits")
    found = read_frame(DATA / f"{name}.fits", pedestal=-10.0)  # the gain is the header's
    np.testing.assert_array_equal(found.valid, stored < 4096)  # a plateau of 11 pixels, or 3
    np.testing.assert_array_equal(found.counts, frame.counts)
    assert "saturation suspected at the maximum of 4096" in found.description
    assert "gain 2.72 (GAIN)" in found.description
    stars = read_catalogue(DATA / f"{name}.csv", magnitude="mag", zero_point=20.0)
    assert np.abs(stars.x).max() < 512
    assert np.abs(stars.y).max() < 384


@needs_data
def test_pinhole_frame() -> None:
    path = DATA / "vimos_pinholes_q2.fits"
    assert "give gain (e-/adu) and pedestal" in message(read_frame, path)
    assert read_frame(path, gain=15.0).counts.shape == (959, 880)
    text = message(read_catalogue, path.with_suffix(".csv"))
    assert "got no column 'flux', expected one of: 'i', 'j', 'x', 'y'" in text

"""Memory is asked for before it is taken, and small files take little of it."""

from __future__ import annotations

import gzip
import io
import math
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from bayesfred.calibration.corrected import read_grid
from bayesfred.errors import InputError
from bayesfred.io import memory
from bayesfred.io.frames import read_frame
from bayesfred.io.memory import allowed_memory, require_room

COUNTS = np.arange(35.0).reshape(5, 7)
MACHINE = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def linux(root: Path, groups: str, **limits: str) -> Path:
    """A folder with the files in which Linux says what limits a process's memory."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text(groups)
    for name, limit in limits.items():
        path = root / "sys/fs/cgroup" / name.replace("__", "/").replace("_D_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(limit)
    return root


def test_a_container_limits_memory(tmp_path: Path) -> None:
    root = linux(tmp_path, "0::/\n", memory_D_max="1000000\n")
    assert allowed_memory(root) == 1e6


def test_the_groups_around_a_process_count_too(tmp_path: Path) -> None:
    limits = {"job__step__memory_D_max": "max\n", "job__memory_D_max": "2000000\n"}
    root = linux(tmp_path, "1:name=systemd:/x\n0::/job/step\n", **limits)
    assert allowed_memory(root) == 2e6


@pytest.mark.parametrize("path", ["/job", "/a/folder/that/the/container/does/not/see"])
def test_control_groups_of_the_first_version(tmp_path: Path, path: str) -> None:
    limits = {"memory__memory_D_limit_in_bytes": "3000000\n"}
    assert allowed_memory(linux(tmp_path, f"4:cpu,memory:{path}\n", **limits)) == 3e6


@pytest.mark.parametrize("limit", ["max\n", "9223372036854771712\n", "", "\xff"])
def test_a_group_without_a_limit_leaves_that_of_the_machine(tmp_path: Path, limit: str) -> None:
    assert allowed_memory(linux(tmp_path, "0::/\n", memory_D_max=limit)) <= MACHINE


def test_no_system_says_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on Windows."""
    monkeypatch.delattr(os, "sysconf")
    monkeypatch.setattr(memory, "resource", None)
    assert allowed_memory(tmp_path) == math.inf


@pytest.mark.parametrize("limit", ["RLIMIT_AS", "RLIMIT_DATA"])
def test_the_limits_of_a_process_count(limit: str) -> None:
    script = (
        f"import resource; resource.setrlimit(resource.{limit}, (2 * 10**9, 2 * 10**9))\n"
        "from bayesfred.io.memory import allowed_memory; print(allowed_memory())"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert float(done.stdout) == 2e9, done.stderr


def test_one_line_says_what_is_needed_and_what_there_is() -> None:
    expected = (
        rf"^study: its table would need about 1e\+91 GB of memory, expected at most the "
        rf"{allowed_memory() / 1e9:.3g} GB that this process may take: ask for less$"
    )
    with pytest.raises(InputError, match=expected):
        require_room("study: its table", 1e100, "ask for less")


BOMB = 64 * 2**20  # bytes


def trailing(filler: bytes) -> bytes:
    buffer = io.BytesIO()
    fits.PrimaryHDU(COUNTS).writeto(buffer)
    return buffer.getvalue() + filler * BOMB


def beside() -> bytes:
    """An image, and a large one with a checksum of which no use is made."""
    buffer = io.BytesIO()
    large = fits.ImageHDU(np.zeros((1, BOMB), np.uint8), name="OTHER")
    large.add_checksum()
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(COUNTS), large]).writeto(buffer)
    return buffer.getvalue()


@pytest.mark.parametrize("kind", ["zeros", "blanks", "another extension"])
@pytest.mark.parametrize("suffix", [".fits", ".fits.gz"])
def test_what_is_not_the_frame_takes_no_memory(tmp_path: Path, kind: str, suffix: str) -> None:
    content = (
        beside() if kind == "another extension" else trailing(b" " if kind[0] == "b" else b"\0")
    )
    path = tmp_path / f"frame{suffix}"
    path.write_bytes(gzip.compress(content, 1) if suffix == ".fits.gz" else content)
    del content
    tracemalloc.start()
    try:
        frame = read_frame(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(frame.counts, COUNTS)
    assert peak < BOMB / 3


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("suffix", [".fits", ".fits.gz"])
@pytest.mark.parametrize("where", ["image", "flags"])
def test_checksums_of_what_is_read_are_verified(
    tmp_path: Path, packed: bool, suffix: str, where: str
) -> None:
    flags = np.zeros(COUNTS.shape, np.int16)
    images = [
        fits.CompImageHDU(data, name=name) if packed else fits.ImageHDU(data, name=name)
        for name, data in (("SCI", COUNTS.astype(np.int16)), ("DQ", flags))
    ]
    path = tmp_path / "sound.fits"
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(path, checksum=True)
    with fits.open(path, disable_image_compression=True) as hdus:
        start = hdus.fileinfo(1 if where == "image" else 2)["datLoc"]
    content = bytearray(path.read_bytes())
    content[start + 3] ^= 1
    path = tmp_path / f"flipped{suffix}"
    path.write_bytes(gzip.compress(content) if suffix == ".fits.gz" else content)
    with pytest.raises(InputError, match=r"CHECKSUM: got a wrong one in \w+, expected"):
        read_frame(path)


def test_a_grid_to_correct_to_has_to_fit(tmp_path: Path) -> None:
    header = fits.PrimaryHDU(COUNTS).header
    header["NAXIS1"] = header["NAXIS2"] = 10**6
    path = tmp_path / "other.fits"
    path.write_bytes(header.tostring().encode() + bytes(2880))
    with pytest.raises(InputError, match="got 1000000 x 1000000 pixels, whose fit would need"):
        read_grid(path)

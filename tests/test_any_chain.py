"""Any chain file gives a result or one line, though its seal says that it is whole.

Hypothesis edits the HDF5 content of sound files and seals them again, as anybody can. Then a
command reads them. The default run makes the same few edits every time, the long one thousands of
new ones.
"""

import contextlib
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn
from matplotlib.figure import Figure
from test_any_input import DOT, STARS, sound_counts
from test_sampling_chain import reseal
from typer.testing import CliRunner

import bayesfred as bf
from bayesfred.cli import app

SECONDS = 120.0  # for a command on a frame of 24 x 24 pixels
KINDS = ("sampled", "free", "joint")

COMMANDS = {
    "report": ["report", "run.h5", "--out", "out.html"],
    "verify": ["verify", "run.h5"],
    "calibration": ["calibration", "run.h5", "--out", "out.h5"],
    "compare": ["compare", "run.h5", "sound.h5"],
    "resume": ["fit", "run.toml", "--resume"],
}
RESUMED = """
frame = {path = "frame.npy"}
catalogue = {path = "stars.csv"}
psf = {sigma = 1.5}
distortion = {f_terms = [[1, 0, 1, 0]], g_terms = [[0, 1, 0, 1]]}
sampling = {steps = 6, ensembles = 2, walkers = 8}
output = {path = "run.h5"}
"""


def make(kind: str, folder: Path) -> None:
    """A sound chain file."""
    stars = bf.SourceCatalog(*np.array(STARS[1:], dtype=float).T)
    terms = bf.PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    model = bf.ForwardModel(bf.Detector((24, 24)), stars, bf.GaussianPSF(1.5), terms)
    flux = "free" if kind == "free" else "fixed"
    one = bf.Posterior(model, sound_counts(), nuisances=bf.Nuisances(flux=flux))
    path = folder / f"{kind}.h5"
    if kind == "sampled":
        how: dict[str, Any] = {"steps": 4, "ensembles": 2, "walkers": 8, "progress": False}
        bf.sample(one, path=path, seed=1, **how)
    elif kind == "free":
        bf.laplace(one, path=path, seed=1, draws=64, progress=False)
    else:
        joint = bf.JointPosterior({"a": one, "b": one}, ["f_ux"])
        bf.laplace(joint, path=path, seed=1, draws=64, progress=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The sound files, and what a run is resumed with."""
    made = tmp_path_factory.mktemp("sound")
    for kind in KINDS:
        make(kind, made)
    np.save(made / "frame.npy", sound_counts())
    (made / "stars.csv").write_text("".join(",".join(row) + "\n" for row in STARS))
    (made / "run.toml").write_text(RESUMED)
    with patch.object(Figure, "savefig", lambda figure, target, **_: target.write(DOT)):
        yield made


NUMBERS = st.sampled_from(
    [0.0, -1.0, 1.0, 0.5, 2.0, 1e15, 1e300, -1e300, 1e-300, 5e-324, 2.0**31, 2.0**53, 2.0**63,
     np.nan, np.inf, -np.inf]
) | st.floats(-100.0, 100.0)  # fmt: skip
WHOLE = st.sampled_from([-1, 0, 1, 2, 3, 2**31, 2**62, 10**9]) | st.integers(-100, 100)
TEXTS = st.sampled_from(
    [b"", b"x" * 70_000, b"\x1b[31m", b"a\nb", b"\xff", b"nan", b"f_ux", b"[/x]"]
)


@st.composite
def values(draw: DrawFn, old: Any) -> Any:
    """Something in place of a value: of its kind and shape, or not."""
    old = np.asarray(old)
    kind = draw(st.sampled_from(["some", "some", "some", "factor", "all", "shape", "kind"]))
    drawn = {"f": NUMBERS, "i": WHOLE, "u": WHOLE, "b": st.booleans()}.get(old.dtype.kind, TEXTS)
    if kind == "kind":
        return draw(
            st.one_of(NUMBERS, WHOLE, TEXTS, st.just(np.zeros(3)), st.just(h5py.Empty("f")))
        )
    if kind == "shape":
        shape = draw(st.lists(st.integers(0, 5), max_size=3))
        return np.resize(old, shape)
    if kind == "factor" and old.dtype.kind == "f":
        with np.errstate(all="ignore"):
            return old * draw(NUMBERS)
    new = draw(drawn)
    with np.errstate(all="ignore"):
        other = np.array(new) if old.dtype.kind == "S" else np.array(new).astype(old.dtype)
    if kind == "all" or not old.size:
        return np.full(old.shape, other)
    out = old.astype(np.promote_types(old.dtype, other.dtype))
    for place in draw(st.lists(st.integers(0, old.size - 1), min_size=1, max_size=5)):
        out.flat[place] = other
    return out


def places(file: h5py.File) -> list[tuple[str, str | None]]:
    """Every attribute, array and group of a file."""
    found: list[tuple[str, str | None]] = [("/", name) for name in file.attrs]

    def see(name: str, item: Any) -> None:
        found.append((name, None))
        found.extend((name, attribute) for attribute in item.attrs)

    file.visititems(see)
    return found


def edit(data: st.DataObject, file: h5py.File) -> str:
    """Change one thing, and say which."""
    name, attribute = data.draw(st.sampled_from(places(file)))
    item = file[name]
    verb = data.draw(st.sampled_from(["change"] * 8 + ["remove", "move"]))
    if attribute is not None:
        if verb == "change":
            old = item.attrs[attribute]
            with contextlib.suppress(TypeError, ValueError, OSError, OverflowError):
                item.attrs[attribute] = data.draw(values(old))
        else:
            del item.attrs[attribute]
        return f"{verb} {name}@{attribute}"
    if verb == "change" and isinstance(item, h5py.Dataset):
        new = data.draw(values(item[()]))
        del file[name]
        with contextlib.suppress(TypeError, ValueError, OSError, OverflowError):
            file.create_dataset(name, data=new)
    elif verb == "move":
        other = data.draw(st.sampled_from(places(file)))[0]
        with contextlib.suppress(RuntimeError, ValueError, KeyError):
            file.copy(other, f"{name} ")
            del file[name]
            file.move(f"{name} ", name)
    else:
        del file[name]
    return f"{verb} {name}"


def check(folder: Path, data: st.DataObject) -> None:
    """Edit a file, and give it to a command."""
    kind, command = data.draw(st.sampled_from(KINDS)), data.draw(st.sampled_from([*COMMANDS]))
    with tempfile.TemporaryDirectory() as name:
        here = Path(name)
        for given_file in ("frame.npy", "stars.csv", "run.toml"):
            shutil.copy(folder / given_file, here)
        shutil.copy(folder / f"{kind}.h5", here / "sound.h5")
        shutil.copy(folder / f"{kind}.h5", here / "run.h5")
        with h5py.File(here / "run.h5", "a", libver="v110") as file:
            for _ in range(data.draw(st.integers(1, 2))):
                said = edit(data, file)
        reseal(here / "run.h5")
        before = {path.name: path.read_bytes() for path in here.iterdir()}
        start = time.monotonic()
        with contextlib.chdir(here), warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            result = CliRunner().invoke(app, COMMANDS[command])
        assert time.monotonic() - start < SECONDS, said
        event(f"{command} {result.exit_code}")
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert not warned, [str(w.message) for w in warned]
        after = {path.name: path.read_bytes() for path in here.iterdir()}
        if result.exit_code == 2:
            assert [name for name in before if after.get(name) != before[name]] == []
            assert result.stderr.startswith("bayesfred: ")
            assert result.stderr[:-1].isprintable()
        assert result.exit_code in (0, 2, 3), result.output
        assert all(c.isprintable() for line in result.stdout.splitlines() for c in line)


FEW: Callable[..., Any] = partial(
    settings, deadline=None, database=None, suppress_health_check=[*HealthCheck]
)


@FEW(max_examples=60, derandomize=True)
@given(data=st.data())
def test_a_result_or_one_line(folder: Path, data: st.DataObject) -> None:
    check(folder, data)


@pytest.mark.long
@FEW(max_examples=10_000, print_blob=True)
@given(data=st.data())
def test_a_result_or_one_line_thousands_of_times(folder: Path, data: st.DataObject) -> None:
    check(folder, data)

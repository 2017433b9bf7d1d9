"""Any input of `bayesfred fit` gives a result or one line: no traceback, warning or lost file.

Hypothesis makes folders of a run file, a catalogue and a frame: a small problem that can be fitted,
spoilt in some places. Runs that are sound but long, by their own settings, are left out. The
default run makes the same few examples every time, of the compiled code that other tests use; the
long one thousands of new ones.
"""

import contextlib
import re
import tempfile
import warnings
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import h5py
import numpy as np
import pytest
from astropy.io import fits
from hypothesis import HealthCheck, assume, event, given, settings
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy
from matplotlib.figure import Figure
from numpy.typing import NDArray
from typer.testing import CliRunner

import bayesfred as bf
from bayesfred.cli import app
from bayesfred.errors import InputError
from bayesfred.sampling.chainfile import open_chain
from bayesfred.settings.run import read_settings

# a picture of one pixel: rendering real ones takes most of the time of a small run
DOT = bytes.fromhex(
    "89504e470d0a1a0a0000000d494844520000000100000001080200000090775"
    "3de0000000c49444154789c63606060000000040001f61738550000000049454e44ae426082"
)


class Files(dict[str, bytes]):
    """Files by name, shown without their data."""

    def __repr__(self) -> str:
        return "\n".join(f"{name}: {content[:1000]!r}" for name, content in self.items())


RUN: dict[str, dict[str, Any]] = {
    "frame": {"path": "frame.npy"},
    "catalogue": {"path": "stars.csv"},
    "psf": {"sigma": 1.5},
    "distortion": {"f_terms": [[1, 0, 1, 0]], "g_terms": [[0, 1, 0, 1]]},
    "sampling": {"steps": 4, "ensembles": 2, "walkers": 8},
    "output": {"path": "run.h5"},
}
SUFFIXES = (".npy", ".fits", ".fits.gz", ".fits.fz", ".h5")
STARS = [["x", "y", "flux"], *([str(x), str(y), "5000"] for x in (-5.0, 5.0) for y in (-5.5, 4.5))]


@cache
def sound_counts() -> NDArray[np.float64]:
    """A frame of these stars."""
    stars = bf.SourceCatalog(*np.array(STARS[1:], dtype=float).T)
    terms = bf.PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    return bf.simulate(
        bf.ForwardModel(bf.Detector((24, 24)), stars, bf.GaussianPSF(1.5), terms),
        [1e-3, -1e-3],
        3.0,
        seed=1,
    )


# Keys and values that a section may have, so that sound runs of many kinds are among the examples.
FINITE = st.floats(allow_nan=False, allow_infinity=False)
FAMILIES = ["norm", "uniform", "halfnorm", "cauchy", "expon", "gamma", "lognorm", "loguniform"]
PRIOR = st.fixed_dictionaries(
    {"distribution": st.sampled_from(FAMILIES)},
    optional={key: st.floats(1e-3, 10) | FINITE for key in ("loc", "scale", "a", "b", "s")},
)
PLACES = [
    "chains/run.h5",
    "link/run.h5",
    "link.h5",
    "../precious/new.h5",
    "precious.h5",
    "{root}/x.h5",
    "./a b.h5",
    "<b>'.h5",
]
SOUND: dict[str, dict[str, SearchStrategy[Any]]] = {
    "frame": {
        "gain": st.floats(0.1, 100),
        "pedestal": st.integers(-100, 0),
        "saturation": st.floats(1, 1e5),
        "reject_outliers": st.booleans(),
    },
    "catalogue": {"flux": st.sampled_from(["x", "flux"]), "x": st.just("y")},
    "detector": {"pixel": st.sampled_from(["impulse", "box"]), "binning": st.integers(1, 4)},
    "psf": {"sigma": st.floats(0.5, 5) | st.floats(1e-3, 100)},
    "distortion": {
        "f_terms": st.lists(
            st.tuples(*[st.integers(0, 2)] * 2, *[st.integers(0, 1)] * 2).map(list), max_size=2
        )
    },
    "model": {"conserve_flux": st.booleans(), "tolerance": st.floats(0, 0.999)},
    "noise": {"kind": st.sampled_from(["poisson", "background"]), "read_noise": st.floats(0, 100)},
    "nuisances": {
        "flux": st.sampled_from(["fixed", "scale", "free"]),
        "offset": st.booleans(),
        "psf_sigma": st.booleans(),
        "background_order": st.sampled_from([0, 1, 2, 4]),
        "footprint": st.floats(0.1, 100),
    },
    "prior": dict.fromkeys(("f_ux", "background", "flux_scale", "psf_sigma"), PRIOR),
    "sampling": {
        "seed": st.integers(0, 2**63 - 1),
        "steps": st.integers(1, 6),
        "walkers": st.sampled_from([4, 8]),
        "target_ess": st.integers(1, 100),
    },
    "output": {"path": st.sampled_from(PLACES)},
}

ODD = ["", "<script>", "[red]", "\x1b[31m", "a\nb", "é☃", "nan", "1e999", "x" * 5000]
TEXTS = st.text(max_size=20) | st.sampled_from(ODD)
NUMBERS = st.one_of(
    st.floats(),
    st.integers(),
    st.sampled_from(
        [
            0,
            -1,
            1,
            0.5,
            2**31,
            2**53,
            2**63,
            10**30,
            10**400,
            1e-300,
            1e300,
            -0.0,
            float("nan"),
            float("inf"),
        ]
    ),
)
VALUES = st.recursive(
    st.one_of(TEXTS, NUMBERS, st.booleans(), st.just(date(2000, 1, 1))),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(TEXTS, inner, max_size=3)),
    max_leaves=8,
)


def toml(value: Any) -> str:
    """A value as TOML writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return (
            '"'
            + "".join(
                c if c.isascii() and c.isprintable() and c not in '\\"' else f"\\U{ord(c):08x}"
                for c in value
            )
            + '"'
        )
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return str(value)


@st.composite
def run_files(draw: DrawFn, suffix: str, *, spoil: bool) -> bytes:
    """A run file, perhaps with keys changed, added and taken away, or bytes damaged."""
    run: dict[str, Any] = {name: dict(table) for name, table in RUN.items()}
    run["frame"]["path"] = f"frame{suffix}"
    for _ in range(draw(st.integers(1, 3)) if spoil else 0):
        section = draw(st.sampled_from([*SOUND]))
        kind = draw(
            st.sampled_from([*["sound"] * 8, "value", "value", "key", "section", "without"])
        )
        if kind == "sound":
            key = draw(st.sampled_from([*SOUND[section]]))
            run.setdefault(section, {})[key] = draw(SOUND[section][key])
        elif kind == "value":
            table = run.setdefault(section, {})
            table[
                draw(st.sampled_from([*SOUND[section], "path", "name", "magnitude", "zero_point"]))
            ] = draw(VALUES)
        elif kind == "key":
            run.setdefault(section, {})[draw(TEXTS)] = draw(VALUES)
        elif kind == "section":
            run[draw(TEXTS)] = draw(VALUES)
        else:
            run.pop(section, None)
    lone = "\n".join(f"{toml(k)} = {toml(v)}" for k, v in run.items() if not isinstance(v, dict))
    tables = (
        f"[{toml(name)}]\n" + "\n".join(f"{toml(k)} = {toml(v)}" for k, v in table.items())
        for name, table in run.items()
        if isinstance(table, dict)
    )
    return "\n".join([lone, *tables, ""]).encode()


@st.composite
def catalogues(draw: DrawFn, *, spoil: bool) -> bytes:
    """A catalogue, perhaps with cells, rows and headings changed."""
    rows = [list(row) for row in STARS]
    for _ in range(draw(st.integers(1, 3)) if spoil else 0):
        row = draw(st.integers(0, len(rows) - 1)) if rows else 0
        kind = draw(
            st.sampled_from(
                ["far", "far", "far", "number", "number", "cell", "row", "again", "drop", "short"]
            )
        )
        if kind == "far":
            rows.append(
                [str(draw(st.floats(-30, 30) | st.floats(-1e3, 1e3))) for _ in "xy"] + ["5000"]
            )
        elif kind == "row":
            rows.append(draw(st.lists(TEXTS, max_size=5)))
        elif kind == "again" and rows:
            rows.append(rows[row])
        elif kind == "drop" and rows:
            del rows[row]
        elif rows and rows[row]:
            column = draw(st.integers(0, len(rows[row]) - 1))
            if kind == "short":
                del rows[row][column]
            else:
                rows[row][column] = draw(
                    st.floats(-20, 20).map(str)
                    if kind == "number"
                    else st.one_of(TEXTS, NUMBERS.map(str))
                )
    return "".join(",".join(row) + "\n" for row in rows).encode("utf-8", "surrogatepass")


@st.composite
def images(draw: DrawFn, *, spoil: bool) -> NDArray[Any]:
    """A frame's array, perhaps with other pixels, shape or type."""
    counts: NDArray[Any] = sound_counts().copy()
    for _ in range(draw(st.integers(1, 2)) if spoil else 0):
        kind = draw(
            st.sampled_from(
                [
                    "pixels",
                    *["whole"] * 3,
                    "constant",
                    "shape",
                    *["crop"] * 2,
                    "type",
                    *["scale"] * 2,
                ]
            )
        )
        if kind in ("pixels", "whole") and counts.size and counts.dtype.kind == "f":
            places = draw(st.lists(st.integers(0, counts.size - 1), min_size=1, max_size=20))
            whole = st.integers(0, 1000) | st.sampled_from([65535, 10**6, 2**50, np.nan])
            counts = counts.copy()
            counts.flat[places] = draw(
                whole
                if kind == "whole"
                else st.floats() | st.sampled_from([np.inf, -1.0, 0.5, 2.0**60])
            )
        elif kind == "constant":
            counts = np.full(
                counts.shape, draw(st.sampled_from([0.0, 1.0, 65535.0, np.nan, -1.0, 1e18, 1e300]))
            )
        elif kind == "shape":
            counts = np.resize(counts, draw(st.lists(st.integers(0, 30), max_size=3).map(tuple)))
        elif kind == "crop" and counts.ndim == 2:
            counts = counts[: draw(st.integers(1, 24)), : draw(st.integers(1, 24))]
        elif kind == "type" and counts.dtype.kind != "S":
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                counts = counts.astype(
                    draw(st.sampled_from(["u1", "i2", "u2", "i8", "f4", ">f8", "c16", "?", "S3"]))
                )
        elif kind == "scale" and counts.dtype.kind == "f":
            with np.errstate(all="ignore"):
                counts = np.rint(counts * draw(st.floats(0, 1e6)))
    return counts


def stored(image: NDArray[Any], suffix: str, folder: Path) -> bytes:
    """The bytes of a frame file."""
    path = folder / f"frame{suffix}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if suffix == ".npy":
            np.save(path, image, allow_pickle=False)
        elif suffix == ".h5":
            with h5py.File(path, "w") as file:
                file["counts"] = image
        elif suffix == ".fits.fz":
            fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(image, quantize_level=0.0)]).writeto(
                path
            )
        else:
            fits.PrimaryHDU(image).writeto(path)
    content = path.read_bytes()
    path.unlink()
    return content


@st.composite
def damaged(draw: DrawFn, content: bytes) -> bytes:
    """Bytes cut, changed, doubled or replaced."""
    kind = draw(st.sampled_from(["cut", "flip", "flip", "card", "double", "other"]))
    if kind == "other" or not content:
        return draw(st.binary(max_size=100))
    place = draw(st.integers(0, len(content) - 1))
    if kind == "cut":
        return content[:place]
    if kind == "double":
        return content + content
    if kind == "card" and b"NAXIS" in content:
        value = draw(NUMBERS)
        start = content.index(
            draw(
                st.sampled_from(
                    [card for card in (b"NAXIS ", b"NAXIS1", b"BITPIX") if card in content]
                )
            )
        )
        return content[: start + 10] + f"{value!s:>20.20}".encode() + content[start + 30 :]
    return content[:place] + draw(st.binary(min_size=1, max_size=4)) + content[place + 1 :]


@st.composite
def inputs(draw: DrawFn) -> Files:
    """The three files, with one or two of them spoilt."""
    suffix = draw(st.sampled_from(SUFFIXES))
    spoilt = draw(st.sets(st.sampled_from(["run", "catalogue", "frame"]), min_size=1, max_size=2))
    image = draw(images(spoil="frame" in spoilt))
    with tempfile.TemporaryDirectory() as folder:
        try:
            frame = stored(image, suffix, Path(folder))
        except Exception:  # FITS has no such type or shape
            suffix = ".npy"
            frame = stored(image, suffix, Path(folder))
    files = Files({
        "run.toml": draw(run_files(suffix, spoil="run" in spoilt)),
        "stars.csv": draw(catalogues(spoil="catalogue" in spoilt)),
        f"frame{suffix}": frame,
    })  # fmt: skip
    if draw(st.integers(0, 9)) == 0:
        name = draw(st.sampled_from(sorted(files)))
        files[name] = draw(damaged(files[name]))
    return files


DRAWN = st.sampled_from([True, False, False, False])


def snapshot(folder: Path) -> dict[str, bytes | None]:
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None
        for p in sorted(folder.rglob("*"))
    }


def is_short(run_file: Path, *, everything: bool) -> bool:
    """Whether a fit of this run file takes a second or so.

    With fixed fluxes, Poisson counts and nothing else of its own to compile, unless everything may
    be.
    """
    try:
        run = read_settings(run_file)
        noise, free = run.noise.make(), run.nuisances.make().flux == "free"
    except InputError:
        return True
    s, d = run.sampling, run.distortion
    u_power = max((m for _, _, m, _ in (*(d.f_terms or ()), *(d.g_terms or ()))), default=0)
    return (
        s.steps is not None and s.steps <= 8 and s.ensembles <= 4 and s.walkers <= 32
        and run.detector.binning <= 4 and u_power <= 1 and d.degree is None
        and (everything or (run.model.conserve_flux and noise == bf.PoissonNoise() and not free))
    )  # fmt: skip


def check(files: Files, drawn: bool, *, everything: bool) -> None:
    """Fit a folder of these files, beside a folder that must stay as it is; render or not."""
    with tempfile.TemporaryDirectory() as name:
        root = Path(name).resolve()
        precious, here = root / "precious", root / "here"
        precious.mkdir()
        here.mkdir()
        (precious / "precious.h5").write_bytes(b"precious")
        (here / "precious.h5").write_bytes(b"precious")
        (here / "link").symlink_to(precious, target_is_directory=True)
        (here / "link.h5").symlink_to(precious / "new.h5")
        for path, content in files.items():
            (here / path).write_bytes(content.replace(b"{root}", bytes(precious)))
        assume(is_short(here / "run.toml", everything=everything))
        before = snapshot(root)
        draw = Figure.savefig if drawn else lambda figure, target, **_: target.write(DOT)
        with (
            contextlib.chdir(here),
            patch.object(Figure, "savefig", draw),
            warnings.catch_warnings(record=True) as warned,
        ):
            warnings.simplefilter("always")
            # what one library deprecates in another is not the package's
            warnings.filterwarnings("ignore", "", DeprecationWarning, "(?!bayesfred)")
            result = CliRunner().invoke(app, ["fit", "run.toml"], env={"BAYESFRED_DATA": None})
        after = snapshot(root)

        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert [str(w.message) for w in warned] == []
        assert {path: after.get(path) for path in before} == before
        made = {path for path in after if path not in before}
        assert all(path.startswith("here/") for path in made)
        visible = {path for path in made if not Path(path).name.startswith(".")} - {"here/chains"}
        event(f"exit {result.exit_code}")
        if result.exit_code == 2:
            assert visible == set()
            assert result.stderr.startswith("bayesfred: ")
            assert result.stderr.endswith("\n")
            assert result.stderr[:-1].isprintable()
        else:
            assert result.exit_code in (0, 3)
            assert re.fullmatch(r"(sampling [^\n]*\n)?", result.stderr)
            assert {Path(path).suffix for path in visible} == {".h5", ".html", ".png", ".ecsv"}
            assert all(c.isprintable() for line in result.stdout.splitlines() for c in line)
            chain = open_chain(next(root / path for path in visible if path.endswith(".h5")))
            assert np.isfinite(chain.chain).all()
            assert np.isfinite(chain.log_prob).all()


@pytest.mark.slow
@settings(max_examples=50, derandomize=True, deadline=None, suppress_health_check=[*HealthCheck])
@given(inputs(), DRAWN)
def test_a_result_or_one_line(files: Files, drawn: bool) -> None:
    check(files, drawn, everything=False)


@pytest.mark.long
@settings(
    max_examples=2000,
    deadline=None,
    database=None,
    print_blob=True,
    suppress_health_check=[*HealthCheck],
)
@given(inputs(), DRAWN)
def test_a_result_or_one_line_thousands_of_times(files: Files, drawn: bool) -> None:
    check(files, drawn, everything=True)

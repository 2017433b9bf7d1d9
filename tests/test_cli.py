"""The command line: whole runs, exit codes, one line for bad input, interruption, places of files.

Most tests run the commands in this process. Problems are small: 60 x 75 pixels, 3 x 3 sources, 3
terms. Every refusal is asked for its exit code, its one line, what the line names, and that no file
changed.
"""

import contextlib
import html
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path

import h5py
import numpy as np
import pytest
from astropy.io import fits
from matplotlib.image import imread
from numpy.typing import NDArray
from typer.testing import CliRunner

import bayesfred
from bayesfred import build
from bayesfred.analysis.diagnostics import diagnose
from bayesfred.cli import app
from bayesfred.commands.pipeline import read_frame
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.io import catalogues, frames
from bayesfred.io.hdf5_checks import seal
from bayesfred.io.tables import read_table
from bayesfred.model.posterior import Posterior
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import fingerprint, open_chain
from bayesfred.settings.run import RunSettings, read_settings
from bayesfred.sources import STRAY

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("BAYESFRED_DATA") or Path(__file__).parents[2] / "shared" / "data")
EXAMPLE = Path(bayesfred.__file__).parent / "settings" / "example.toml"

TRUTH = {"f_ux": 2e-4, "f_ux2": 5e-6, "g_vy": -3e-4}
BACKGROUND = 3.0
NAMES = (*TRUTH, "background")

SECTIONS = {
    "frame": 'path = "frame.fits"',
    "catalogue": 'path = "stars.csv"',
    "psf": "sigma = 2.5",
    "distortion": "f_terms = [[1, 0, 1, 0], [2, 0, 1, 0]]\ng_terms = [[0, 1, 0, 1]]",
    "sampling": "target_ess = 200",
    "output": 'path = "run.h5"',
    "simulation": f"shape = [60, 75]\nbackground = {BACKGROUND}",
    "simulation.theta": "\n".join(f"{name} = {value}" for name, value in TRUTH.items()),
    "simulation.grid": "side = 3\nspacing = 16.0\nflux = 5e3",
}

FEW_STEPS = "steps = 12"


@dataclass(frozen=True)
class Output:
    """What a command left: its exit code and what it printed."""

    code: int
    stdout: str
    stderr: str


def run_text(**sections: str) -> str:
    """The small problem's run file, with the sections given in place of its own."""
    return "\n".join(f"[{name}]\n{keys}\n" for name, keys in {**SECTIONS, **sections}.items())


def invoke(folder: Path, *args: str | Path, data: Path | None = None) -> Output:
    """Run a command in a folder; what would be a traceback for the user is raised here."""
    env = {"BAYESFRED_DATA": None if data is None else str(data), "COLUMNS": "120"}
    with contextlib.chdir(folder):
        result = CliRunner().invoke(app, [str(a) for a in args], env=env, catch_exceptions=False)
    return Output(result.exit_code, result.stdout, result.stderr)


def command(*args: str) -> list[str]:
    """The installed command as a process of its own, which a Ctrl-C reaches in any case."""
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from "
        "bayesfred.__main__ import main; main()"
    )
    return [sys.executable, "-c", code, *args]


def environment(**extra: str) -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "BAYESFRED_DATA"} | extra


def read(folder: Path) -> tuple[Posterior, list[str]]:
    """The posterior of the run file in a folder, and the notes that screen and page get."""
    posterior, _, notes = read_frame(read_settings(folder / "run.toml"), folder / "run.toml", None)
    return posterior, notes


def snapshot(folder: Path) -> dict[str, bytes | None]:
    """Every file and folder below a folder, with its content; the lock, which stays, left out."""
    found = [p for p in sorted(folder.rglob("*")) if p.suffix != ".lock"]
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in found}


def z_scores(chain: Chain, truth: dict[str, float]) -> dict[str, float]:
    """Posterior mean less truth in standard deviations, by parameter."""
    draws = chain.draws()
    z = (draws.mean(axis=0) - [truth[name] for name in chain.parameter_names]) / draws.std(axis=0)
    return dict(zip(chain.parameter_names, z.tolist(), strict=True))


def without_waits(text: str) -> str:
    """Standard error without what a slow machine is told every half minute."""
    return re.sub(r"^[^\n]+: \d+ s\r?\n", "", text, flags=re.MULTILINE)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run file, and the frame and catalogue that `simulate` made of it."""
    folder = tmp_path_factory.mktemp("simulated")
    (folder / "run.toml").write_text(run_text(), encoding="utf-8")
    output = invoke(folder, "simulate", "run.toml")
    assert (output.code, without_waits(output.stderr)) == (0, "")
    assert "stars.csv: 9 sources" in output.stdout
    assert re.search(r"frame\.fits: \d+ x \d+ pixels, \d+ counts", output.stdout)
    assert sorted(path.name for path in folder.iterdir()) == ["frame.fits", "run.toml", "stars.csv"]
    return folder


@pytest.fixture(scope="module")
def finished(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Output]:
    """A folder in which a fit has ended well, and what the fit printed."""
    folder = tmp_path_factory.mktemp("finished")
    shutil.copytree(simulated, folder, dirs_exist_ok=True)
    return folder, invoke(folder, "fit", "run.toml")


@pytest.fixture
def folder(simulated: Path, tmp_path: Path) -> Path:
    """A copy of the simulated folder, to be spoilt."""
    return Path(shutil.copytree(simulated, tmp_path / "here"))


# --------------------------------------------------------------------------------------------------


def test_simulated_frame_is_what_the_run_file_describes(simulated: Path) -> None:
    frame = frames.read_frame(simulated / "frame.fits")
    stars = catalogues.read_catalogue(simulated / "stars.csv")
    assert frame.counts.shape == (60, 75)
    assert sorted(set(stars.x)) == sorted(set(stars.y)) == [-16.0, 0.0, 16.0]
    assert set(stars.flux) == {5e3}
    # nearly all light falls into the frame; 5 standard deviations of the Poisson sum
    expected = 9 * 5e3 + BACKGROUND * 60 * 75
    assert abs(frame.counts.sum() - expected) < 5 * expected**0.5


def test_fit_leaves_a_chain_a_page_and_a_picture(finished: tuple[Path, Output]) -> None:
    folder, output = finished
    assert output.code == 0
    assert "Traceback" not in output.stderr
    visible = {path.name for path in folder.iterdir() if not path.name.startswith(".")}
    left = {"run.h5", "run.html", "run.png", "run.sources.ecsv"}
    assert visible == {"run.toml", "frame.fits", "stars.csv", *left}
    for word in (
        "parameter",
        "MAP",
        "posterior mean",
        "R-hat",
        "ESS",
        "none masked",
        "run.h5",
        "run.html",
        "run.png",
        "run.sources.ecsv",
    ):
        assert word in output.stdout
    rows = [
        line for line in output.stdout.splitlines() if any(f"{name} " in line for name in NAMES)
    ]
    assert [next(name for name in NAMES if f" {name} " in row) for row in rows] == list(NAMES)
    check_verdict(folder, output, trustworthy=True)


def test_the_table_of_sources_is_that_of_the_diagnostics(finished: tuple[Path, Output]) -> None:
    chain = open_chain(finished[0] / "run.h5")
    table = read_table(finished[0] / "run.sources.ecsv")
    expected = diagnose(chain).sources
    assert list(table.columns) == expected.colnames
    for name in expected.colnames:
        assert np.array_equal(table.columns[name], expected[name], equal_nan=True)


def check_verdict(folder: Path, output: Output, *, trustworthy: bool) -> None:
    """Exit code, last line of the terminal and banner of the page say the same."""
    last = output.stdout.splitlines()[-1]
    assert output.code == (0 if trustworthy else 3)
    assert last.startswith("trustworthy: " if trustworthy else "not trustworthy: ")
    page = (folder / "run.html").read_text(encoding="utf-8")
    banner = re.search(r'class="verdict (good|bad)" role="status">\s*([^<]*)</p>', page)
    assert banner is not None
    assert (banner[1], html.unescape(banner[2])) == ("good" if trustworthy else "bad", last)


def test_a_psf_that_is_too_wide_is_not_trusted(folder: Path) -> None:
    """20 % too wide, it is sampled as well as the right one; the counts and the verdict say so."""
    sections(psf="sigma = 3.0")(folder)
    output = invoke(folder, "fit", "run.toml")
    check_verdict(folder, output, trustworthy=False)
    assert re.search(
        r"^not trustworthy: The model does not fit the counts: .* Sampled well: ",
        output.stdout,
        re.M,
    )


@pytest.mark.slow
def test_python_callers_hear_nothing_unless_they_ask(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    sections(sampling=FEW_STEPS)(folder)
    heard: list[str] = []
    with contextlib.chdir(folder):
        result = bayesfred.commands.fit("run.toml")
        bayesfred.commands.simulate_frame("run.toml", overwrite=True)
        bayesfred.commands.verify("run.h5")
        assert capfd.readouterr() == ("", "")
        bayesfred.commands.fit("run.toml", overwrite=True, say=heard.append)
    assert capfd.readouterr().out == ""
    assert [line.split(":")[0] for line in heard] == ["frame.fits", "stars.csv", "maximum"]
    assert result.summary["name"].tolist() == list(NAMES)
    assert not result.diagnostics.sampled_well and not result.diagnostics.trustworthy


def test_fit_recovers_the_truth(finished: tuple[Path, Output]) -> None:
    """4.5: of four scores, normal if the error bars hold, one in 37,000 frames has a larger one."""
    folder, _ = finished
    chain = open_chain(folder / "run.h5")
    assert chain.parameter_names == NAMES
    assert max(map(abs, z_scores(chain, {**TRUTH, "background": BACKGROUND}).values())) < 4.5


class _Tags(HTMLParser):
    """Collect the tags of a page and what they refer to."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.references: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.references += [
            value or ""
            for name, value in attrs
            if name in ("src", "href", "srcset", "data", "action")
        ]


def check_page_and_picture(folder: Path, stem: str) -> None:
    """The page stands alone and the picture shows something."""
    page = (folder / f"{stem}.html").read_text(encoding="utf-8")
    found = _Tags(page)
    assert {"html", "table", "img"} <= found.tags
    assert not found.tags & {"script", "link", "iframe", "object", "embed", "base"}
    assert found.references
    assert all(re.match("data:image/png;base64,|#", text) for text in found.references)
    assert not re.search(r"@import|url\(", page)
    picture = np.asarray(imread(folder / f"{stem}.png"))
    assert picture.ndim == 3
    assert min(picture.shape[:2]) > 300
    assert picture.std() > 0.01


def test_page_stands_alone_and_picture_can_be_read(finished: tuple[Path, Output]) -> None:
    check_page_and_picture(finished[0], "run")


def test_report_rebuilds_page_and_picture(finished: tuple[Path, Output], tmp_path: Path) -> None:
    shutil.copy(finished[0] / "run.h5", tmp_path)
    before = (tmp_path / "run.h5").read_bytes()
    output = invoke(tmp_path, "report", "run.h5", "--target-ess", "200")
    assert output.code == 0
    assert all(name in output.stdout for name in NAMES)
    check_page_and_picture(tmp_path, "run")
    assert (tmp_path / "run.h5").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "run.h5",
        "run.html",
        "run.png",
        "run.sources.ecsv",
    ]  # a reader takes no lock


@pytest.mark.slow
def test_report_that_asks_for_more_than_there_is_exits_with_3(
    finished: tuple[Path, Output], tmp_path: Path
) -> None:
    shutil.copy(finished[0] / "run.h5", tmp_path)
    output = invoke(tmp_path, "report", "run.h5", "--target-ess", "1000000")
    assert output.code == 3
    assert re.search(
        r"^not trustworthy: The model fits .* Not sampled well: effective sample size \d+ of \w+ "
        r"is below 1000000\. The error bars leave out ",
        output.stdout,
        re.M,
    )


def test_verify_says_what_holds(finished: tuple[Path, Output], tmp_path: Path) -> None:
    """Exit code 0 for the run as it is, 3 for one of another seed, 2 for one that was changed."""
    shutil.copy(finished[0] / "run.h5", tmp_path)
    before = snapshot(tmp_path)
    output = invoke(tmp_path, "verify", "run.h5", "--all")
    assert output.code == 0
    assert snapshot(tmp_path) == before
    rows = [line for line in output.stdout.splitlines() if re.search(r" (yes|no) +│$", line)]
    assert len(rows) == 11
    assert all(" yes " in row for row in rows)
    draws = np.prod(open_chain(tmp_path / "run.h5").log_prob.shape)
    assert f"{draws} of {draws} draws" in output.stdout
    assert "made with" not in output.stdout

    path = tmp_path / "run.h5"
    with h5py.File(path, "a") as file:
        file.attrs["seed"] = 99
        file["versions"].attrs["numpy"] = np.bytes_("1.0")
    assert_refused(invoke(tmp_path, "verify", "run.h5"), "run.h5", "seal")
    path.write_bytes(path.read_bytes() + seal(path.read_bytes()))
    output = invoke(tmp_path, "verify", "run.h5")
    assert output.code == 3
    assert re.search(
        r"│ first steps +│ \d+ replayed from seed 99: differ from step 1 on +│ no ", output.stdout
    )
    assert re.search(
        r"│ log-probability +│ 1000 of \d+ draws: differ by at most 0 +│ yes ", output.stdout
    )
    assert f"made with numpy 1.0 (here {np.__version__})" in output.stdout


@pytest.mark.slow
def test_too_few_steps_then_resume_then_overwrite(folder: Path) -> None:
    (folder / "run.toml").write_text(run_text(sampling=FEW_STEPS), encoding="utf-8")
    first = invoke(folder, "fit", "run.toml")
    assert first.code == 3
    assert re.search(
        r"^not trustworthy: .* Not sampled well: .*effective sample size \d+ of \w+ is below 1000",
        first.stdout,
        re.M,
    )
    chain = open_chain(folder / "run.h5")
    assert chain.chain.shape == (4, 12, 32, 4)

    before = snapshot(folder)
    assert_refused(invoke(folder, "fit", "run.toml"), "run.h5", "exists", "--resume", "--overwrite")
    assert snapshot(folder) == before

    assert invoke(folder, "fit", "run.toml", "--resume").code == 3
    resumed = open_chain(folder / "run.h5")
    np.testing.assert_array_equal(resumed.chain, chain.chain)
    np.testing.assert_array_equal(resumed.log_prob, chain.log_prob)
    np.testing.assert_array_equal(resumed.accepted, chain.accepted)

    other = run_text(sampling="steps = 9\nseed = 2")
    (folder / "run.toml").write_text(other, encoding="utf-8")
    assert invoke(folder, "fit", "run.toml", "--overwrite").code == 3
    replaced = open_chain(folder / "run.h5")
    assert (replaced.seed, replaced.chain.shape[1]) == (2, 9)


def test_resume_refuses_another_frame(finished: tuple[Path, Output], folder: Path) -> None:
    shutil.copy(finished[0] / "run.h5", folder)
    spoil_pixel(4.0)(folder)
    before = (folder / "run.h5").read_bytes()
    assert_refused(invoke(folder, "fit", "run.toml", "--resume"), "run.h5", "counts")
    assert (folder / "run.h5").read_bytes() == before


def test_masked_pixels_are_counted(folder: Path) -> None:
    spoil_pixel(np.nan)(folder)
    posterior, notes = read(folder)
    assert notes[0] == "frame.fits: 60 x 75 pixels, 1 masked (1 NaN)"
    mask = posterior.mask
    assert not mask[5, 7]
    assert mask.sum() == mask.size - 1


def test_what_the_prior_dominates_is_named(folder: Path) -> None:
    # the frame alone knows the background, which is 3, to 0.026
    prior = {"prior.background": 'distribution = "norm"\nloc = 3.05\nscale = 0.02'}
    (folder / "run.toml").write_text(run_text(sampling=FEW_STEPS, **prior), encoding="utf-8")
    output = invoke(folder, "fit", "run.toml")
    assert "prior-dominated: background: " in output.stdout
    assert "Prior-dominated: background." in (folder / "run.html").read_text(encoding="utf-8")
    row = next(line for line in output.stdout.splitlines() if " background " in line)
    assert float(row.split("│")[-2]) > 0.05


def test_demo(tmp_path: Path) -> None:
    """4: of 13 normal scores one in 1,200 demos has a larger one; the seed is fixed."""
    output = invoke(tmp_path, "demo", "--folder", "commands")
    assert output.code == 0
    folder = tmp_path / "commands"
    assert {path.name for path in folder.iterdir() if not path.name.startswith(".")} == {
        "demo.h5",
        "demo.html",
        "demo.png",
        "demo.sources.ecsv",
    }
    check_page_and_picture(folder, "demo")
    chain = open_chain(folder / "demo.h5")
    simulation = tomllib.loads(EXAMPLE.read_text(encoding="utf-8"))["simulation"]
    truth = {
        **dict.fromkeys(chain.parameter_names, 0.0),
        **simulation["theta"],
        "background": simulation["background"],
    }
    z = z_scores(chain, truth)
    assert len(z) == 13
    assert max(map(abs, z.values())) < 4
    verdict = diagnose(chain)
    assert max(verdict.rhat.values()) <= 1.01
    assert min(*verdict.ess_bulk.values(), *verdict.ess_tail.values()) >= 1000
    for name, score in z.items():  # the table shows the same
        row = next(line for line in output.stdout.splitlines() if f" {name} " in line)
        assert any(
            abs(float(cell) - score) < 0.02 for cell in re.findall(r" ([+-]\d+\.\d\d) ", row)
        )
        assert float(row.split("│")[-2]) == pytest.approx(verdict.prior_sensitivity[name], abs=6e-4)
    assert (
        verdict.prior_dominated == () and "prior-dominated" not in output.stdout
    )  # the default priors are weak
    displaced, photons, last = output.stdout.splitlines()[-3:]
    assert re.match(
        r"Displacement: rms \d\.\d+ px, up to \d+\.\d px at \(u, v\) = \(-?\d+, -?\d+\); known to "
        r"0\.00\d+ px rms, 0\.0\d+ px at worst",
        displaced,
    )
    assert re.match(r"For an error of 0\.001 px rms: sources of \d,\d\d0,000 photons", photons)
    assert last == verdict.message

    # the settings on its page describe the same frame, model and run
    (tmp_path / "run.toml").write_text(settings_on(folder / "demo.html"))
    assert invoke(tmp_path, "simulate", "run.toml").code == 0
    assert fingerprint(read(tmp_path)[0]) == fingerprint(chain.posterior())
    described = read_settings(tmp_path / "run.toml").sampling
    assert (described.seed, described.ensembles) == (chain.seed, len(chain.chain))
    assert chain.record is not None
    assert chain.record.truth == pytest.approx([truth[name] for name in chain.parameter_names])

    before = snapshot(tmp_path)
    assert_refused(
        invoke(tmp_path, "demo", "--folder", "commands"), "demo.h5", "exists", "--overwrite"
    )
    assert snapshot(tmp_path) == before


def test_example_in_help_is_a_run_file(tmp_path: Path) -> None:
    output = invoke(tmp_path, "fit", "--help")
    assert output.code == 0
    example = textwrap.dedent(output.stdout.split("A complete run file:")[1])
    (tmp_path / "run.toml").write_text(example, encoding="utf-8")
    assert read_settings(tmp_path / "run.toml") == read_settings(EXAMPLE)


def test_every_command_is_explained(tmp_path: Path) -> None:
    listed = invoke(tmp_path, "--help").stdout
    for name in ("demo", "simulate", "fit", "report", "compare", "verify"):
        assert re.search(rf"^\s+{name}\s+\w", listed, re.M)
        assert invoke(tmp_path, name, "--help").code == 0


def test_console_script_is_the_app() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "scripts"
    ]
    assert scripts == {"bayesfred": "bayesfred.__main__:main"}


# --------------------------------------------------------------------------------------------------

Prepare = Callable[[Path], None]


def sections(**changed: str) -> Prepare:
    """Change sections of the run file."""

    def prepare(folder: Path) -> None:
        (folder / "run.toml").write_text(run_text(**changed), encoding="utf-8")

    return prepare


def content(name: str, text: str) -> Prepare:
    """Put a text in place of a file."""

    def prepare(folder: Path) -> None:
        (folder / name).write_text(text, encoding="utf-8")

    return prepare


def without(name: str) -> Prepare:
    return lambda folder: (folder / name).unlink()


def spoil_pixel(value: float) -> Prepare:
    """Change one pixel of the frame, at row 5, column 7."""

    def prepare(folder: Path) -> None:
        counts = frames.read_frame(folder / "frame.fits").counts.copy()
        counts[5, 7] = value
        frames.write_frame(folder / "frame.fits", counts, overwrite=True)

    return prepare


def same_counts(value: float) -> Prepare:
    """Give all pixels of the frame one value."""
    counts = np.full((60, 75), value)
    return lambda folder: frames.write_frame(folder / "frame.fits", counts, overwrite=True)


def cut_frame(size: int) -> Prepare:
    """Keep the first bytes of the frame."""
    return lambda folder: (folder / "frame.fits").write_bytes(
        (folder / "frame.fits").read_bytes()[:size]
    )


def claim(columns: int, rows: int) -> Prepare:
    """Let the frame's header claim a size; the data stay."""

    def prepare(folder: Path) -> None:
        content = (folder / "frame.fits").read_bytes()
        for card, value in ((b"NAXIS1  =", columns), (b"NAXIS2  =", rows)):
            start = content.index(card)
            content = content[:start] + card + f"{value:>21}".encode() + content[start + 30 :]
        (folder / "frame.fits").write_bytes(content)

    return prepare


def link(name: str, target: str) -> Prepare:
    return lambda folder: (folder / name).symlink_to(folder / target)


def both(*steps: Prepare) -> Prepare:
    def prepare(folder: Path) -> None:
        for step in steps:
            step(folder)

    return prepare


def frame_without_image(folder: Path) -> None:
    """A FITS file of one header: 36 cards of 80 characters, and no data."""
    cards = (
        "SIMPLE  =                    T",
        "BITPIX  =                    8",
        "NAXIS   =                    0",
        "END",
    )
    (folder / "frame.fits").write_bytes(
        "".join(card.ljust(80) for card in cards).ljust(2880).encode()
    )


def frame_in_hdf5(folder: Path) -> None:
    """Put the frame where the chain would go."""
    frames.write_frame(folder / "run.h5", frames.read_frame(folder / "frame.fits").counts)


def unchanged(folder: Path) -> None:
    """Leave everything as it is."""


@dataclass(frozen=True)
class Refusal:
    """Input that a command refuses: what is spoilt, what is run, what the line says."""

    name: str
    prepare: Prepare
    words: tuple[str, ...]
    args: tuple[str, ...] = ("fit", "run.toml")


SIMULATE = ("simulate", "run.toml", "--overwrite")
OVERWRITE = ("fit", "run.toml", "--overwrite")
MIRRORED = 'terms = "mirrored"'
IN_HDF5 = 'path = "run.h5"'
TOO_LARGE = "shape = [1000000, 1000000]\nbackground = 1"
FOLDED = 'distribution = "uniform"\nloc = -0.3\nscale = 0.1'
ON_AXIS = "f_terms = [[1, 0, 1, 0]]\ng_terms = [[0, 0, 2, 0]]"

REFUSALS = [
    Refusal("missing run file", unchanged, ("absent.toml", "no such file"), ("fit", "absent.toml")),
    Refusal(
        "run file not TOML", content("run.toml", "frame: frame.fits"), ("run.toml", "not TOML")
    ),
    Refusal(
        "unknown key",
        sections(frame='path = "frame.fits"\ngian = 2.0'),
        ("run.toml", "frame.gian", "'gain'"),
    ),
    Refusal("missing frame", without("frame.fits"), ("run.toml", "frame.fits", "BAYESFRED_DATA")),
    Refusal("not a FITS", content("frame.fits", "no FITS at all"), ("frame.fits", "FITS")),
    Refusal("truncated FITS", cut_frame(20_000), ("frame.fits", "FITS")),
    Refusal("truncated header", cut_frame(1000), ("frame.fits", "FITS")),
    Refusal("empty FITS", cut_frame(0), ("frame.fits", "FITS")),
    Refusal(
        "absurd NAXIS",
        claim(10**9, 10**9),
        ("frame.fits", "1000000000 x 1000000000 pixels", "GB of memory", "bin"),
    ),
    Refusal(
        "more than memory",
        claim(10**6, 10**5),
        ("frame.fits", "100000 x 1000000 pixels", "GB of memory", "bin"),
    ),
    Refusal("negative NAXIS", claim(-75, 60), ("frame.fits",)),
    Refusal("no image", frame_without_image, ("frame.fits", "2-D image")),
    Refusal("negative counts", spoil_pixel(-3.0), ("frame.fits", "-3", "row 5, column 7", "gain")),
    Refusal("part of a count", spoil_pixel(1.5), ("frame.fits", "1.5", "row 5, column 7", "gain")),
    Refusal(
        "more than float64 counts",
        spoil_pixel(1e300),
        ("frame.fits", "1e+300", "row 5, column 7", "at most 9e+15"),
    ),
    Refusal(
        "nested TOML",
        content("run.toml", f"deep = {'[' * 20_000}{']' * 20_000}"),
        ("run.toml", "nested too deeply"),
    ),
    Refusal("nan in TOML", sections(psf="sigma = nan"), ("run.toml", "psf.sigma", "nan", "finite")),
    Refusal(
        "inf in TOML",
        sections(model="tolerance = -inf"),
        ("run.toml", "model.tolerance", "inf", "finite"),
    ),
    Refusal(
        "text for a number",
        sections(psf='sigma = "2.5"'),
        ("run.toml", "psf.sigma", "'2.5'", "number"),
    ),
    Refusal(
        "number for a text", sections(frame="path = 7"), ("run.toml", "frame.path", "7", "string")
    ),
    Refusal(
        "date for a text",
        sections(frame="path = 2000-01-01"),
        ("run.toml", "frame.path", "2000-01-01", "string"),
    ),
    Refusal(
        "array for a table",
        content("run.toml", "frame = [1]"),
        ("run.toml", "frame", "[1]", "table"),
    ),
    Refusal(
        "duplicate sources",
        content("stars.csv", "x,y,flux\n1,2,9\n3,4,9\n1,2,8\n"),
        ("stars.csv", "row 3", "in row 1"),
    ),
    Refusal(
        "negative flux",
        content("stars.csv", "x,y,flux\n1,2,-9\n"),
        ("stars.csv", "row 1", "'flux'", "-9", "positive"),
    ),
    Refusal(
        "absurd flux",
        content("stars.csv", "x,y,flux\n1,2,1e200\n"),
        ("stars.csv", "row 1", "'flux'", "1e+200", "at most 9e+15"),
    ),
    Refusal(
        "nan position",
        content("stars.csv", "x,y,flux\nnan,2,9\n"),
        ("stars.csv", "row 1", "'x'", "nan", "finite"),
    ),
    Refusal("missing catalogue", without("stars.csv"), ("run.toml", "stars.csv", "BAYESFRED_DATA")),
    Refusal(
        "missing column",
        content("stars.csv", "x,y,light\n0,0,1\n"),
        ("stars.csv", "'flux'", "'light'"),
    ),
    Refusal("empty catalogue", content("stars.csv", "x,y,flux\n"), ("stars.csv", "empty")),
    Refusal("catalogue of no bytes", content("stars.csv", ""), ("stars.csv", "empty")),
    Refusal(
        "output exists",
        content("run.h5", "precious"),
        ("run.h5", "exists", "--resume", "--overwrite"),
    ),
    Refusal("page exists", content("run.html", "precious"), ("run.html", "exists", "--overwrite")),
    Refusal("picture exists", content("run.png", "precious"), ("run.png", "exists", "--overwrite")),
    Refusal(
        "table of sources exists",
        content("run.sources.ecsv", "precious"),
        ("run.sources.ecsv", "exists", "--overwrite"),
    ),
    Refusal(
        "output is a folder",
        lambda folder: (folder / "run.h5").mkdir(),
        ("run.h5", "folder", "remove"),
        OVERWRITE,
    ),
    Refusal(
        "output is the frame",
        both(frame_in_hdf5, sections(frame=IN_HDF5)),
        ("got a file that is read",),
        OVERWRITE,
    ),
    Refusal("name too long", sections(output=f'path = "{"a" * 990}.h5"'), (".h5", "too long")),
    Refusal(
        "name too long for its companions",
        sections(output=f'path = "{"a" * 250}.h5"'),
        (".h5", "too long"),
    ),
    Refusal(
        "missing output folder",
        sections(output='path = "absent/run.h5"'),
        ("run.h5", "no folder absent"),
    ),
    Refusal(
        "simulated frame too large",
        sections(simulation=TOO_LARGE),
        ("run.toml", "simulation.shape", "GB"),
        SIMULATE,
    ),
    Refusal(
        "folded map",
        sections(**{"simulation.theta": "f_ux = -0.2"}),
        ("run.toml", "simulation.theta", "folds"),
        SIMULATE,
    ),
    Refusal(
        "no simulation",
        content("run.toml", run_text().split("[simulation]")[0]),
        ("run.toml", "simulation"),
        SIMULATE,
    ),
    Refusal(
        "unknown true term",
        sections(**{"simulation.theta": "f_zz = 1"}),
        ("run.toml", "simulation.theta", "f_zz"),
        SIMULATE,
    ),
    Refusal(
        "simulated files exist", unchanged, ("exists", "--overwrite"), ("simulate", "run.toml")
    ),
    Refusal("missing chain", unchanged, ("absent.h5", "no such file"), ("report", "absent.h5")),
    Refusal("no chain", unchanged, ("frame.fits", "seal"), ("report", "frame.fits")),
]

# What is wrong here is found by the objects that the run file describes, which name the field.
DESCRIBED = [
    Refusal(
        "sources outside",
        content("stars.csv", "x,y,flux\n900,0,5e3\n0,800,5e3\n"),
        ("catalogue", "2 sources", "outside"),
    ),
    Refusal("term on the axis", sections(distortion=ON_AXIS), ("g_terms", "g_u2", "i + j >= 1")),
    Refusal("narrow PSF", sections(psf="sigma = 0.3"), ("psf", "sigma", "0.3", "impulse", "box")),
    Refusal(
        "narrow PSF to simulate",
        sections(psf="sigma = 0.3"),
        ("run.toml", "psf", "sigma", "0.3"),
        SIMULATE,
    ),
    *(
        Refusal(
            f"wide PSF for {args[0]}", sections(psf=f"sigma = {width}"), ("psf: sigma", "75"), args
        )
        for width in ("1e6", "1e15")
        for args in (("fit", "run.toml"), SIMULATE, ("study", "run.toml"))
    ),
    Refusal(
        "more sources than the PSF separates",
        content("stars.csv", "x,y,flux\n" + "".join(f"{k}e-9,0,1\n" for k in range(60_000))),
        ("catalogue: got 1799970000 pairs", "360 GB of memory", "merge"),
    ),
    Refusal(
        "more steps than memory holds",
        sections(sampling="steps = 1000000000000000"),
        ("sampling: got 4 ensembles of 32 walkers", "1000000000000000 steps", "GB of memory"),
    ),
    Refusal(
        "more frames than memory holds",
        sections(study="path = 's.ecsv'\nreplicates = 10000000\nflux = [1, 2, 3, 4, 5, 6, 7, 8]"),
        ("study: got 80000000 frames, whose table", "GB of memory"),
        ("study", "run.toml"),
    ),
    Refusal("dark frame", same_counts(0.0), ("counts: got 0 in each of 4500", "no information")),
    Refusal(
        "frame of one level", same_counts(100.0), ("counts: got 100 in each", "no information")
    ),
    Refusal(
        "gain of nothing",
        sections(frame='path = "frame.fits"\ngain = 1e-15'),
        ("counts: got at most", "of 4500 pixels", "gain"),
    ),
    Refusal(
        "prior of nothing",
        sections(**{"prior.f_zz": 'distribution = "norm"'}),
        ("prior", "f_zz", "g_vy"),
    ),
    Refusal("folds alone", sections(**{"prior.f_ux": FOLDED}), ("run.toml", "no density", "fold")),
    Refusal(
        "pixels wider than the PSF",
        sections(psf="sigma = 1e-4", detector='pixel = "box"'),
        ("psf", "sigma", "1e+04", "box"),
    ),
    Refusal(
        "unknown distribution",
        sections(**{"prior.f_ux": 'distribution = "nrm"'}),
        ("prior.f_ux", "distribution", "'nrm'"),
    ),
    Refusal(
        "prior's keyword",
        sections(**{"prior.f_ux": 'distribution = "norm"\nsd = 1'}),
        ("prior.f_ux", "norm", "sd"),
    ),
]


def by_name(refusals: list[Refusal]) -> list[object]:
    return [pytest.param(refusal, id=refusal.name) for refusal in refusals]


def assert_refused(output: Output, *words: str) -> None:
    """Exit code 2 and one line, which has every word."""
    assert output.code == 2
    assert output.stderr.startswith("bayesfred: ")
    assert output.stderr.endswith("\n")
    assert len(output.stderr.splitlines()) == 1
    assert [word for word in words if word not in output.stderr] == []


def check_refusal(refusal: Refusal, folder: Path) -> Output:
    refusal.prepare(folder)
    before = snapshot(folder)
    output = invoke(folder, *refusal.args)
    assert_refused(output, *refusal.words)
    assert snapshot(folder) == before
    return output


def names_a_file(output: Output) -> bool:
    """Whether the line begins with the file that has to be corrected."""
    return (
        re.match(r"bayesfred: [^:]*\.(toml|fits|csv|h5|html|png|ecsv): ", output.stderr) is not None
    )


@pytest.mark.parametrize("refusal", by_name(REFUSALS))
def test_bad_input_is_one_line_that_names_the_file(refusal: Refusal, folder: Path) -> None:
    assert names_a_file(check_refusal(refusal, folder))


@pytest.mark.parametrize("refusal", by_name(DESCRIBED))
def test_bad_value_is_one_line_that_names_run_file_and_field(
    refusal: Refusal, folder: Path
) -> None:
    assert names_a_file(check_refusal(refusal, folder))


def test_more_parameters_than_the_frame_determines(folder: Path) -> None:
    """One source cannot tell terms apart that differ in the power of its own position alone."""
    sections(distortion=MIRRORED)(folder)
    output = check_refusal(
        Refusal("", content("stars.csv", "x,y,flux\n8,8,5000\n"), ("cannot determine",)), folder
    )
    named = set(re.findall(r"\b[fg]_[uvxy2]+\b", output.stderr))
    mirrored = {
        f"{letter}_{term}{axis}" for letter, axis in ("fx", "gy") for term in ("u", "v", "u2", "v2")
    }
    mirrored |= {f"{letter}_{term}{axis}2" for letter, axis in ("fx", "gy") for term in ("u", "v")}
    assert named
    assert named < mirrored


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def flip_a_byte(path: Path) -> None:
    """Change one byte of the draws."""
    with h5py.File(path, "r") as file:
        place = file["ensemble_0/chain"].id.get_chunk_info(0).byte_offset + 800
    data = bytearray(path.read_bytes())
    data[place] ^= 0xFF
    path.write_bytes(data)


def drop_an_ensemble(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["ensemble_1"]


def change_schema(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["schema"] = 99


@pytest.mark.parametrize("change", [cut, change_schema, flip_a_byte, drop_an_ensemble])
def test_damaged_chain(
    change: Callable[[Path], None], finished: tuple[Path, Output], tmp_path: Path
) -> None:
    shutil.copy(finished[0] / "run.h5", tmp_path)
    change(tmp_path / "run.h5")
    assert names_a_file(
        check_refusal(Refusal("", unchanged, ("run.h5",), ("report", "run.h5")), tmp_path)
    )


@pytest.mark.parametrize("scale", ["0.0", "-1.0"])
def test_prior_without_width(scale: str, folder: Path) -> None:
    prior = sections(**{"prior.background": f'distribution = "norm"\nloc = 3.0\nscale = {scale}'})
    check_refusal(Refusal("", prior, ("prior.background", "scale")), folder)


@pytest.mark.parametrize("suffix", [".html", ".png"])
def test_output_that_the_report_would_replace(suffix: str, folder: Path) -> None:
    output = sections(output=f'path = "run{suffix}"', sampling=FEW_STEPS)
    check_refusal(Refusal("", output, ("run.toml", "output.path", ".h5")), folder)


def test_simulate_writes_both_files_or_none(folder: Path) -> None:
    check_refusal(
        Refusal("", without("stars.csv"), ("frame.fits", "exists"), ("simulate", "run.toml")),
        folder,
    )


def test_demo_folder_is_a_file(folder: Path) -> None:
    check_refusal(
        Refusal("", unchanged, ("run.toml", "folder"), ("demo", "--folder", "run.toml")), folder
    )


def test_wrong_option(folder: Path) -> None:
    before = snapshot(folder)
    output = invoke(folder, "fit", "run.toml", "--fast")
    assert output.code == 2
    assert "--fast" in output.stderr
    assert snapshot(folder) == before


def test_refusal_from_a_shell(folder: Path) -> None:
    """A process of its own: exit code, nothing on standard output, one line, no traceback."""
    done = subprocess.run(
        command("fit", "absent.toml"),
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert_refused(Output(done.returncode, done.stdout, done.stderr), "absent.toml")
    assert done.stdout == ""


# ------------------------------------------------------------------------------------------- what i


def settings_on(page: Path) -> str:
    """The run file that a page shows, as a browser would copy it."""
    found = re.search(r"<pre[^>]*>(.*?)</pre>", page.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return html.unescape(found[1])


def page_text(path: Path) -> str:
    """What a browser shows of a page."""
    return html.unescape(re.sub(r"<[^>]*>", "", path.read_text(encoding="utf-8")))


@pytest.mark.parametrize("suffix", [".fits.gz", ".fits.fz"])
def test_compressed_frames_are_read(suffix: str, folder: Path) -> None:
    frames.write_frame(folder / f"frame{suffix}", frames.read_frame(folder / "frame.fits").counts)
    sections(frame=f'path = "frame{suffix}"')(folder)
    counts = read(folder)[0].counts
    np.testing.assert_array_equal(counts, frames.read_frame(folder / "frame.fits").counts)


def test_saturated_and_lost_pixels_are_counted_on_screen_and_page(folder: Path) -> None:
    counts = frames.read_frame(folder / "frame.fits").counts.copy()
    counts[0, :3], counts[1, :2], counts[2, 0] = 5000.0, np.nan, np.inf
    frames.write_frame(folder / "frame.fits", counts, overwrite=True)
    sections(frame='path = "frame.fits"\nsaturation = 5000', sampling=FEW_STEPS)(folder)
    output = invoke(folder, "fit", "run.toml")
    line = "frame.fits: 60 x 75 pixels, 6 masked (2 NaN, 1 infinite, 3 saturated)"
    for said in (line, "stars.csv: 9 sources, 0 at the frame's edge, 0 outside removed"):
        assert said in output.stdout
        assert said in page_text(folder / "run.html")
    mask = open_chain(folder / "run.h5").posterior().mask
    np.testing.assert_array_equal(mask, np.isfinite(counts) & (counts < 5000))


@pytest.mark.slow
def test_outliers_are_rejected_if_asked_for(folder: Path) -> None:
    """The catalogue lacks a star of the frame, and has one of 5,000 photons that is not there."""
    lines = (folder / "stars.csv").read_text().splitlines()
    (folder / "stars.csv").write_text("\n".join([*lines[:3], *lines[4:], "24,8,5000", ""]))
    output = invoke(folder, "fit", "run.toml")
    assert (
        "exceed the noise" in output.stdout and "(reject_outliers leaves them out)" in output.stdout
    )
    sections(frame='path = "frame.fits"\nreject_outliers = true')(folder)
    output = invoke(folder, "fit", "run.toml", "--overwrite")
    assert output.code == 0
    line = next(line for line in output.stdout.splitlines() if line.startswith("outliers: "))
    assert re.fullmatch(
        r"outliers: 1 unmatched of 9 sources removed, \d+ of 4500 pixels masked", line
    )
    assert line in page_text(folder / "run.html")
    chain = open_chain(folder / "run.h5")
    posterior = chain.posterior()
    assert len(posterior.model.sources) == 8 and 24.0 not in posterior.model.sources.x
    x, y = (float(value) for value in lines[3].split(",")[:2])
    assert not posterior.mask[round(y + 29.5), round(x + 37.0)]
    assert max(abs(z) for z in z_scores(chain, TRUTH | {"background": BACKGROUND}).values()) < 4.0
    assert invoke(folder, "verify", "run.h5").code == 0
    draws = chain.draws()
    assert invoke(folder, "fit", "run.toml", "--resume").code == 0  # rejects the same
    np.testing.assert_array_equal(open_chain(folder / "run.h5").draws()[: len(draws)], draws)


def test_sources_at_the_edge_are_kept_and_others_removed(folder: Path) -> None:
    """The frame ends at 37.5 and 30: one added source is inside, one just outside, two far away."""
    text = (folder / "stars.csv").read_text()
    (folder / "stars.csv").write_text(text + "36,0,5000\n-39,-31,5000\n80,0,5000\n0,-1e300,5000\n")
    posterior, notes = read(folder)
    assert notes[1] == "stars.csv: 13 sources, 2 at the frame's edge, 2 outside removed"
    sources = posterior.model.sources
    assert sources.x.tolist()[-2:] == [36.0, -39.0]
    assert len(sources) == 11


def test_a_source_removed_as_outside_changes_no_pixel(simulated: Path) -> None:
    """A source just beyond gives no light, even if a distortion of 3 prior sd brings it nearer."""
    run = read_settings(simulated / "run.toml")
    model = open_model(run, x=37.5 * (1 + STRAY) + 2.5 * (-2 * np.log(1e-8)) ** 0.5)
    prior = 0.1 / 37.5  # of f_ux: a tenth of the half-width at the corner
    theta = np.array([3 * prior, 0.0, 0.0]) * 37.5 / model.sources.x[0]
    assert model.expected_counts(theta).max() < 1e-7 * 5e3
    assert open_model(run, x=36.0).expected_counts(theta).max() > 100  # what is inside does


def open_model(run: RunSettings, x: float) -> ForwardModel:
    sources = SourceCatalog(np.array([x]), np.array([0.0]), np.array([5e3]))
    return build.forward_model(run, (60, 75), sources, GaussianPSF(2.5))


@pytest.mark.slow
def test_zero_background(folder: Path) -> None:
    """Pixels without light and without counts."""
    sections(simulation="shape = [60, 75]\nbackground = 0", sampling=FEW_STEPS)(folder)
    assert invoke(folder, *SIMULATE).code == 0
    assert invoke(folder, "fit", "run.toml").code == 3
    chain = open_chain(folder / "run.h5")
    assert np.median(chain.posterior().counts) == 0
    assert np.isfinite(chain.chain).all() and np.isfinite(chain.log_prob).all()


def test_counts_where_none_are_expected_are_impossible(finished: tuple[Path, Output]) -> None:
    """Without a background no light, but counts, far from the sources: -inf, and NaN never."""
    posterior = open_chain(finished[0] / "run.h5").posterior()
    params = np.array([*TRUTH.values(), 0.0])
    assert posterior.expected_counts(params).min() == 0
    assert posterior.log_prob(params) == -np.inf
    np.testing.assert_array_equal(
        posterior.log_prob(np.stack([params, params])), [-np.inf, -np.inf]
    )
    assert np.isfinite(posterior.log_prob([*TRUTH.values(), 1e-3]))


# -------------------------------------------------------------------------------------------- what


def escape(kind: str) -> Prepare:
    """Let the run file name an output outside its folder, in one of several ways."""

    def prepare(folder: Path) -> None:
        outside = folder.parent / "outside"
        outside.mkdir()
        (folder / "link").symlink_to(outside)
        (folder / "round").symlink_to("round")
        paths = {
            "absolute": f"{outside}/run.h5",
            "parent": "../outside/run.h5",
            "parent below": "link/../../outside/run.h5",
            "link": "link/run.h5",
            "circle": "round/run.h5",
            "zero byte": "a\\u0000.h5",
        }
        sections(output=f'path = "{paths[kind]}"', sampling=FEW_STEPS)(folder)

    return prepare


@pytest.mark.parametrize(
    "kind", ["absolute", "parent", "parent below", "link", "circle", "zero byte"]
)
def test_no_chain_outside_the_folder_of_the_run(kind: str, folder: Path) -> None:
    check_refusal(Refusal("", escape(kind), ("run.toml", "output.path"), OVERWRITE), folder)
    assert snapshot(folder.parent / "outside") == {}


def test_no_chain_through_a_linked_default_folder(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    (folder / "chains").symlink_to(tmp_path / "outside")
    (folder / "run.toml").write_text(
        run_text(sampling=FEW_STEPS).replace('[output]\npath = "run.h5"', "[output]")
    )
    check_refusal(Refusal("", unchanged, ("run.toml", "output.path", "leads out of")), folder)


@pytest.mark.parametrize(
    "name", ["run.h5", "run.html", "run.png", "run.sources.ecsv", ".run.h5.lock"]
)
@pytest.mark.parametrize("target", ["precious", "absent"])
@pytest.mark.parametrize("option", ["", "--overwrite", "--resume"])
def test_links_are_not_written_through(name: str, target: str, option: str, folder: Path) -> None:
    (folder / "precious").write_text("precious")
    args = ("fit", "run.toml", *([option] if option else []))
    assert names_a_link(
        check_refusal(Refusal("", link(name, target), (name, "link", "remove"), args), folder)
    )


def names_a_link(output: Output) -> bool:
    return re.match(r"bayesfred: [^ ]+: got a link", output.stderr) is not None


def test_report_replaces_links_and_leaves_their_targets(
    finished: tuple[Path, Output], tmp_path: Path
) -> None:
    shutil.copy(finished[0] / "run.h5", tmp_path)
    for name in ("run.html", "run.png", "run.sources.ecsv"):
        (tmp_path / f"precious {name}").write_text("precious")
        (tmp_path / name).symlink_to(f"precious {name}")
    assert_refused(invoke(tmp_path, "report", "run.h5"), "run.html", "exists", "--overwrite")
    assert invoke(tmp_path, "report", "run.h5", "--overwrite").code in (0, 3)
    for name in ("run.html", "run.png", "run.sources.ecsv"):
        assert (tmp_path / f"precious {name}").read_text() == "precious"
        assert not (tmp_path / name).is_symlink()


def test_report_does_not_replace_its_chain(finished: tuple[Path, Output], tmp_path: Path) -> None:
    shutil.copy(finished[0] / "run.h5", tmp_path / "run.png")
    check_refusal(Refusal("", unchanged, ("run.png", "rename"), ("report", "run.png")), tmp_path)


@pytest.mark.parametrize("section", ["frame", "catalogue"])
@pytest.mark.parametrize("place", ["../outside/new{}", "{root}/outside/new{}", "link/new{}"])
def test_simulate_writes_beside_the_run_file_only(
    section: str, place: str, folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "outside").mkdir()
    (folder / "link").symlink_to(tmp_path / "outside")
    path = place.format({"frame": ".fits", "catalogue": ".csv"}[section], root=tmp_path)
    check_refusal(
        Refusal(
            "", sections(**{section: f'path = "{path}"'}), ("run.toml", f"{section}.path"), SIMULATE
        ),
        folder,
    )
    assert snapshot(tmp_path / "outside") == {}


EVIL = """<img src=x onerror="alert(1)">'&amp;{{ 7 * 7 }}"""


def test_names_are_escaped_on_the_page(folder: Path) -> None:
    """The title is the run file's name; frame and catalogue are in notes, columns in settings."""
    (folder / "frame.fits").rename(folder / f"{EVIL}.fits")
    (folder / "stars.csv").write_text(
        (folder / "stars.csv").read_text().replace("flux", "<script>")
    )
    (folder / "stars.csv").rename(folder / f"{EVIL}.csv")
    toml = json.dumps(EVIL)[:-1]
    catalogue = f'path = {toml}.csv"\nflux = "<script>"'
    (folder / f"{EVIL}.toml").write_text(
        run_text(frame=f'path = {toml}.fits"', catalogue=catalogue, sampling=FEW_STEPS)
    )
    assert invoke(folder, "fit", f"{EVIL}.toml").code == 3
    page = (folder / "run.html").read_text(encoding="utf-8")
    found = _Tags(page)
    assert "script" not in found.tags
    assert all(re.match("data:image/png;base64,|#", text) for text in found.references)
    assert 'onerror="' not in page
    shown = page_text(folder / "run.html")
    assert f"{EVIL}.fits: 60 x 75 pixels" in shown
    assert f"{EVIL}.csv: 9 sources" in shown
    assert 'flux = "<script>"' in shown


CONTROL = "\x1b[31m[bold red]\r\nnight\x07\udcff"


def test_control_characters_and_markup_are_escaped(folder: Path) -> None:
    """In names of files and FITS extensions, on the screen and on the page."""
    escaped = r"\x1b[31m[bold red]\r\nnight\x07\udcff"
    assert escaped in invoke(folder, "fit", f"{CONTROL}.toml").stderr
    os.replace(folder / "run.toml", folder / f"{CONTROL}.toml")
    text = run_text(sampling=FEW_STEPS).replace('[output]\npath = "run.h5"', "[output]")
    (folder / f"{CONTROL}.toml").write_text(text)
    output = invoke(folder, "fit", f"{CONTROL}.toml")
    assert output.code == 3
    assert all(c.isprintable() for line in output.stdout.splitlines() for c in line)
    assert f"chains/{escaped}.h5" in output.stdout
    page = (folder / "chains" / f"{CONTROL}.html").read_text(encoding="utf-8")
    assert f"<title>{escaped}: frame.fits, 60 × 75 pixels, " in page

    image = fits.ImageHDU(np.zeros((2, 2, 2)), name="<script>[red]")
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(folder / "frame.fits", overwrite=True)
    assert (
        "<SCRIPT>[RED] 2 x 2 x 2" in invoke(folder, "fit", f"{CONTROL}.toml", "--overwrite").stderr
    )


# --------------------------------------------------------------------------------------------------


def wait_for(
    condition: Callable[[], object], process: subprocess.Popen[bytes], seconds: float
) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, "the run ended by itself"
        assert time.monotonic() < end, "the run did not begin to sample"
        time.sleep(0.02)


def stop_a_run(folder: Path, number: signal.Signals) -> tuple[int, list[str]]:
    """Send a signal to a run that has made some steps: exit code, lines on standard error."""
    sections(sampling="steps = 100000")(folder)
    # the progress bar counts steps on standard error, also in a file if it takes that for a
    # terminal
    env = environment(FORCE_COLOR="1", TERM="xterm", COLUMNS="120")
    log = folder / "stderr.txt"
    with log.open("wb") as stderr:
        process = subprocess.Popen(
            command("fit", "run.toml"),
            cwd=folder,
            env=env,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
        )
    try:
        wait_for(lambda: re.search(rb"\b[1-9]\d* steps", log.read_bytes()), process, 180)
        process.send_signal(number)
        code = process.wait(60)
    except subprocess.TimeoutExpired:
        pytest.fail(f"the run did not end: {log.read_text(encoding='utf-8')[-2000:]!r}")
    finally:
        process.kill()
        process.wait()
    return code, messages(log.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def interrupted(
    simulated: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, int, list[str]]:
    """A run that got a Ctrl-C: folder, exit code, lines on standard error."""
    folder = Path(shutil.copytree(simulated, tmp_path_factory.mktemp("interrupted") / "here"))
    return folder, *stop_a_run(folder, signal.SIGINT)


def messages(text: str) -> list[str]:
    """Lines on standard error that are not progress."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)  # colours
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "\n", text)  # what moves the cursor
    progress = re.compile(
        r"\s*|. (searching for|loading|judging|drawing) ?.*|sampling [━╸╺ ]+ (\d+ steps )?[\d:. -]*"
    )
    return [line for line in text.splitlines() if not progress.fullmatch(line)]


def test_ctrl_c_saves_the_steps(interrupted: tuple[Path, int, list[str]]) -> None:
    """The run can be read, and resumes with the very draws of a run without the interruption."""
    folder, code, lines = interrupted
    assert code == 130
    stopped = open_chain(folder / "run.h5")
    steps = stopped.chain.shape[1]
    said = f"bayesfred: interrupted; run.h5 holds {steps} steps: resume it with --resume"
    assert lines[-1] == said
    assert 1 <= steps < 100_000
    assert not list(folder.glob("*.html"))

    sections(sampling=f"steps = {steps + 8}")(folder)
    assert invoke(folder, "fit", "run.toml", "--resume").code in (0, 3)
    resumed = open_chain(folder / "run.h5")
    assert resumed.chain.shape[1] == steps + 8
    np.testing.assert_array_equal(resumed.chain[:, :steps], stopped.chain)

    sections(sampling=f"steps = {steps + 8}", output='path = "unbroken.h5"')(folder)
    assert invoke(folder, "fit", "run.toml").code in (0, 3)
    unbroken = open_chain(folder / "unbroken.h5")
    np.testing.assert_array_equal(unbroken.chain, resumed.chain)
    np.testing.assert_array_equal(unbroken.log_prob, resumed.log_prob)
    np.testing.assert_array_equal(unbroken.accepted, resumed.accepted)


def test_an_interrupt_says_what_is_true(
    simulated: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Where nothing was saved, nothing is to be resumed."""

    def stopped(*args: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("bayesfred.commands.verify", stopped)
    (tmp_path / "run.h5").touch()
    output = invoke(tmp_path, "verify", "run.h5")
    assert output.code == 130
    assert output.stderr.splitlines() == ["bayesfred: interrupted; nothing had to be saved"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_termination_saves_the_steps(name: str, simulated: Path, tmp_path: Path) -> None:
    """SIGTERM, as batch systems send it, and a closed terminal end a run as Ctrl-C does."""
    folder = Path(shutil.copytree(simulated, tmp_path / "here"))
    code, lines = stop_a_run(folder, getattr(signal, name))
    assert code == 130
    assert lines[-1].startswith("bayesfred: interrupted; ")
    steps = open_chain(folder / "run.h5").chain.shape[1]
    sections(sampling=f"steps = {steps + 1}")(folder)
    assert invoke(folder, "fit", "run.toml", "--resume").code in (
        0,
        3,
    )  # as so many steps suffice, or do not
    assert open_chain(folder / "run.h5").chain.shape[1] == steps + 1


def test_ctrl_c_in_a_likelihood_says_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ensembles take turns, a call a step, after four for the walkers: the 18th is in step four."""
    log_prob = Posterior.log_prob
    calls = 0

    def stop(posterior: Posterior, params: NDArray[np.float64]) -> object:
        nonlocal calls
        calls += params.ndim == 2 and len(params) > 1  # the search asks for one at a time
        if calls == 18:
            raise KeyboardInterrupt
        return log_prob(posterior, params)

    monkeypatch.setattr(Posterior, "log_prob", stop)
    output = invoke(folder, "fit", "run.toml")
    assert output.code == 130
    assert open_chain(folder / "run.h5").chain.shape[1] == 3
    assert len(messages(output.stderr)) == 1
    assert "Traceback" not in output.stdout


@pytest.mark.slow
def test_log_probabilities_that_are_no_numbers_are_counted(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log_prob = Posterior.log_prob
    calls = 0

    def spoilt(posterior: Posterior, params: NDArray[np.float64]) -> NDArray[np.float64]:
        nonlocal calls
        values = log_prob(posterior, params)
        calls += len(params) in (
            16,
            32,
        )  # an ensemble, or half of it in a step of differential evolution
        if len(params) in (16, 32) and calls > 4:  # which place the walkers
            values[:2] = np.nan, np.inf
        return values

    monkeypatch.setattr(Posterior, "log_prob", spoilt)
    sections(sampling=FEW_STEPS)(folder)
    output = invoke(folder, "fit", "run.toml")
    assert output.code == 3
    assert calls >= 4 + 12 * 4
    assert (
        f"\n{2 * (calls - 4)} log-probabilities were NaN or infinite and taken as -inf"
        in output.stdout
    )


def test_ctrl_c_before_sampling(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("bayesfred.sampling.sampler.find_map", stop)
    before = snapshot(folder)
    output = invoke(folder, "fit", "run.toml")
    assert output.code == 130
    assert output.stderr.startswith("bayesfred: interrupted")
    assert output.stderr.count("\n") == 1
    assert snapshot(folder) == before


# --------------------------------------------------------------------------------------------------


def with_bad_pixels(source: Path, target: Path, n: int) -> None:
    """Copy a frame with its first n pixels spoilt, which the description counts."""
    counts: NDArray[np.float64] = frames.read_frame(source).counts.copy()
    counts[0, :n] = np.nan
    target.parent.mkdir(exist_ok=True)
    frames.write_frame(target, counts, overwrite=True)


def test_paths_are_beside_the_run_file_then_in_the_data_folder(
    folder: Path, tmp_path: Path
) -> None:
    """An unknown prior ends the runs once the files are read."""
    data, away = tmp_path / "data", tmp_path / "away"
    away.mkdir()
    with_bad_pixels(folder / "frame.fits", data / "frame.fits", 2)
    with_bad_pixels(folder / "frame.fits", folder / "frame.fits", 1)
    shutil.copy(folder / "stars.csv", data)
    sections(**{"prior.f_zz": 'distribution = "norm"'})(folder)
    run_file = folder / "run.toml"

    assert "1 masked (1 NaN)" in invoke(away, "fit", run_file, data=data).stdout
    (folder / "frame.fits").unlink()
    (folder / "stars.csv").unlink()
    assert "2 masked (2 NaN)" in invoke(away, "fit", run_file, data=data).stdout
    nowhere = invoke(away, "fit", run_file, data=away)
    assert_refused(nowhere, str(folder / "frame.fits"), str(away / "frame.fits"))
    shutil.copy(data / "frame.fits", away)  # the folder one happens to be in is not looked at
    assert_refused(invoke(away, "fit", run_file), str(folder / "frame.fits"))


@pytest.mark.slow
def test_default_output_is_in_chains_here_and_named_after_the_run_file(
    folder: Path, tmp_path: Path
) -> None:
    away = tmp_path / "away"
    away.mkdir()
    text = run_text(sampling=FEW_STEPS).replace('[output]\npath = "run.h5"', "[output]")
    (folder / "night.toml").write_text(text, encoding="utf-8")
    assert invoke(away, "fit", folder / "night.toml").code == 3
    made = {path.name for path in (away / "chains").iterdir() if not path.name.startswith(".")}
    assert made == {"night.h5", "night.html", "night.png", "night.sources.ecsv"}


def test_simulate_leaves_the_data_folder_alone(simulated: Path, tmp_path: Path) -> None:
    data, here = tmp_path / "data", tmp_path / "here"
    shutil.copytree(simulated, data)
    here.mkdir()
    sections(simulation="shape = [60, 75]\nbackground = 3.0\nseed = 2")(here)
    before = snapshot(data)
    assert invoke(here, "simulate", "run.toml", "--overwrite", data=data).code == 0
    assert snapshot(data) == before
    assert sorted(path.name for path in here.iterdir()) == ["frame.fits", "run.toml", "stars.csv"]


REAL = pytest.mark.skipif(
    not (DATA / "startracker_alt60_azi45.fits").is_file(),
    reason="no real frames: BAYESFRED_DATA does not name their folder",
)


@REAL
@pytest.mark.long
def test_real_frame_is_sampled(tmp_path: Path) -> None:
    """The same to the end: the walkers stay about the maximum, and most of their moves succeed."""
    example = ROOT / "examples" / "startracker.toml"
    output = invoke(tmp_path, "fit", example, data=DATA)
    assert output.code == 0
    assert output.stdout.strip().splitlines()[-1].startswith("trustworthy: ")
    chain = open_chain(tmp_path / "chains" / "startracker.h5")
    assert chain.accepted.mean() > 0.3 * chain.chain.shape[1]
    theta = slice(0, 18)
    claimed = np.sqrt(np.diag(chain.estimate.covariance))[theta]
    draws = chain.draws()[:, theta]
    assert np.all(np.abs(draws.mean(axis=0) - chain.estimate.params[theta]) < claimed)
    np.testing.assert_allclose(draws.std(axis=0), claimed, rtol=0.3)


@REAL
@pytest.mark.long
def test_real_frame(tmp_path: Path) -> None:
    """A star tracker's frame with the example's run file: the model fits, and is nearly normal.

    One star is off its place by more than its footprint.
    """
    example = ROOT / "examples" / "startracker.toml"
    output = invoke(tmp_path, "fit", example, "--map-only", data=DATA)
    assert "hidden by them: rows 52 of the catalogue" in output.stdout
    verdict = output.stdout.strip().splitlines()[-1]
    found = re.search("trustworthy: The model fits the counts: .*efficiency ([0-9]+)%", verdict)
    # 80 % of 1,000 draws; 64 draws know it to 6 %
    assert found is not None and int(found[1]) > 80 - 4 * 6
    assert output.code == (3 if verdict.startswith("not ") else 0)
    assert ("sample it" in verdict) == (output.code == 3)
    check_page_and_picture(tmp_path / "chains", "startracker")
    chain = open_chain(tmp_path / "chains" / "startracker.h5")
    posterior, params = chain.posterior(), chain.estimate.params
    slopes = dipoles(posterior, params)
    # the root mean square of n standard normal numbers has a Monte Carlo error of 1 / sqrt(2 n)
    assert slopes.size > 100 and np.sqrt(np.mean(slopes**2)) < 1 + 4 / np.sqrt(2 * slopes.size)
    # negative control: all stars 0.2 pixel beside their places
    fixed = replace(posterior.nuisances, position_scatter=False)
    rigid = Posterior(posterior.model, posterior.counts, mask=posterior.mask, nuisances=fixed)
    known = dict(zip(posterior.parameter_names, params, strict=True))
    known["offset_x"] += 0.2
    there = np.array([known[name] for name in rigid.parameter_names])
    assert np.sqrt(np.mean(dipoles(rigid, there) ** 2)) > 1.5


def dipoles(posterior: Posterior, params: NDArray[np.float64]) -> NDArray[np.float64]:
    """Residuals at every star projected on the model's slopes along v and u, in units of sigma."""
    expected, sigma = posterior.expected_counts(params), posterior.sigma(params)
    residual = (posterior.counts - expected) / sigma
    sources, (ny, nx) = posterior.model.sources, expected.shape
    found = []
    for x, y in zip(sources.x + (nx - 1) / 2, sources.y + (ny - 1) / 2, strict=True):
        if 5 <= x < nx - 5 and 5 <= y < ny - 5:
            near = np.s_[round(y) - 4 : round(y) + 5, round(x) - 4 : round(x) + 5]
            used = posterior.mask[near]
            for slope in np.gradient(expected[near]) if used.any() else ():
                part = (slope / sigma[near])[used]
                found.append(part @ residual[near][used] / np.linalg.norm(part))
    return np.array(found)

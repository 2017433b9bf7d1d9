"""Whose files are whose: no command replaces what it did not make, or what it reads."""

import contextlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_cli import FEW_STEPS, Output, assert_refused, invoke, run_text, snapshot
from test_cli import folder as folder
from test_cli import simulated as simulated

import bayesfred
from bayesfred.errors import InputError
from bayesfred.io.frames import read_frame, write_frame
from bayesfred.io.lock import only_writer
from bayesfred.sampling.chainfile import open_chain

PRODUCTS = ("run.html", "run.png", "run.sources.ecsv")
STUDY = "path = 's.ecsv'\nreplicates = 2"


@pytest.fixture(scope="module")
def made(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short run and a study."""
    folder = tmp_path_factory.mktemp("made")
    shutil.copytree(simulated, folder, dirs_exist_ok=True)
    (folder / "run.toml").write_text(run_text(sampling=FEW_STEPS, study=STUDY), encoding="utf-8")
    assert invoke(folder, "fit", "run.toml").code == 3  # few steps
    assert invoke(folder, "study", "run.toml", "--workers", "1").code == 0
    return folder


@pytest.fixture
def here(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "here"))


def refused(folder: Path, *args: str, words: tuple[str, ...]) -> None:
    before = snapshot(folder)
    assert_refused(invoke(folder, *args), *words)
    assert snapshot(folder) == before


# --- resuming -------------------------------------------------------------------------------------


def foreign(path: Path) -> None:
    path.write_text("mine", encoding="utf-8")


def edited(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\n<!-- a note of mine -->\n")


def of_another_run(path: Path) -> None:
    """The same file of a run with another seed, which somebody kept here."""
    other = path.parent / "other"
    other.mkdir()
    for name in ("frame.fits", "stars.csv"):
        shutil.copy(path.parent / name, other)
    sampling, study = f"{FEW_STEPS}\nseed = 5", f"{STUDY}\nseed = 5"
    (other / "run.toml").write_text(run_text(sampling=sampling, study=study), encoding="utf-8")
    command = ("study", "--workers", "1") if path.name.startswith("s.") else ("fit",)
    invoke(other, command[0], "run.toml", *command[1:])
    shutil.move(other / path.name, path)
    shutil.rmtree(other)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change"),
    [
        *((name, change) for name in (*PRODUCTS, "s.summary.ecsv", "s.png")
          for change in (foreign, edited)),
        ("run.html", of_another_run), ("s.png", of_another_run),
    ],
)  # fmt: skip
def test_resuming_replaces_nothing_that_the_run_did_not_make(
    here: Path, name: str, change: Callable[[Path], None]
) -> None:
    change(here / name)
    command = "study" if name.startswith("s.") else "fit"
    refused(
        here, command, "run.toml", "--resume", words=(f"{name}: exists", "not as this run wrote it")
    )


@pytest.mark.slow
def test_resuming_replaces_what_the_run_made(here: Path) -> None:
    before = snapshot(here)
    longer, more = FEW_STEPS.replace("12", "14"), STUDY.replace("2", "3")
    (here / "run.toml").write_text(run_text(sampling=longer, study=more), encoding="utf-8")
    assert invoke(here, "fit", "run.toml", "--resume").code in (0, 3)
    assert invoke(here, "study", "run.toml", "--resume", "--workers", "1").code == 0
    after = snapshot(here)
    assert before.keys() == after.keys()
    changed = {name for name in after if after[name] != before[name]}
    # the table of sources is that of the maximum, which does not change
    assert changed | {"run.sources.ecsv"} == {
        *PRODUCTS, "run.h5", "run.toml", "s.ecsv", "s.summary.ecsv", "s.png"
    }  # fmt: skip
    (here / "run.html").unlink()
    assert invoke(here, "report", "run.h5", "--overwrite").code in (0, 3)
    assert invoke(here, "fit", "run.toml", "--resume").code in (
        0,
        3,
    )  # the report's files are the run's


def test_a_study_does_not_take_a_catalogue_or_a_picture_of_a_fit(here: Path) -> None:
    """A study called as the run is, so that its picture has the name of the run's."""
    study = "path = 'run.ecsv'\nreplicates = 2"
    (here / "run.toml").write_text(run_text(sampling=FEW_STEPS, study=study), encoding="utf-8")
    args = ("study", "run.toml", "--workers", "1")
    refused(here, *args, words=("run.png: exists", "write elsewhere"))
    (here / "run.png").rename(here / "kept.png")
    assert invoke(here, *args).code == 0
    shutil.copy(here / "kept.png", here / "run.png")
    refused(here, *args, "--resume", words=("run.png: exists", "not as this run wrote it"))


@pytest.mark.slow
def test_what_comes_while_a_run_is_made_stays(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that somebody put there between the beginning of a fit and its end."""
    for name in ("run.h5", *PRODUCTS):
        (here / name).unlink()

    def say(line: str) -> None:
        if line.startswith("maximum"):
            foreign(here / "run.png")

    with contextlib.chdir(here), pytest.raises(InputError, match=r"run.png: exists, and is not as"):
        bayesfred.commands.fit("run.toml", say=say)
    assert (here / "run.png").read_text() == "mine" and not (here / "run.html").exists()
    assert open_chain(here / "run.h5").chain.shape[1] == 12  # saved nevertheless
    (here / "run.png").unlink()
    assert invoke(here, "fit", "run.toml", "--resume").code == 3


# --- inputs ---------------------------------------------------------------------------------------


def named(**changed: str) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        (folder / "run.toml").write_text(run_text(**changed), encoding="utf-8")

    return prepare


def picture_frame(name: str) -> Callable[[Path], None]:
    """The frame as a picture of that name."""

    def prepare(folder: Path) -> None:
        counts = read_frame(folder / "frame.fits").counts
        Image.fromarray(counts.astype(np.uint16)).save(folder / name)
        frame = f"path = '{name}'\ngain = 1.0"
        named(frame=frame, sampling=FEW_STEPS, study=STUDY)(folder)

    return prepare


def catalogue(name: str) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        (folder / "stars.csv").rename(folder / "stars")
        rows = (folder / "stars").read_text(encoding="utf-8")
        head = "".join(
            f"# - {{name: {column}, datatype: float64}}\n" for column in ("x", "y", "flux")
        )
        text = f"# %ECSV 1.0\n# ---\n# delimiter: ','\n# datatype:\n{head}{rows}"
        (folder / name).write_text(text, encoding="utf-8")
        named(catalogue=f"path = '{name}'", sampling=FEW_STEPS, study=STUDY)(folder)

    return prepare


def psf_image(name: str) -> Callable[[Path], None]:
    """A sampled PSF."""

    def prepare(folder: Path) -> None:
        x = np.arange(-30, 31) / 3.0
        image = np.exp(-0.5 * (x**2 + x[:, None] ** 2) / 2.5**2)
        write_frame(folder / name, image / image.sum() * 9.0, overwrite=True)
        psf = f"kind = 'sampled'\npath = '{name}'\noversampling = 3"
        named(psf=psf, sampling=FEW_STEPS, study=STUDY)(folder)

    return prepare


def renamed_run_file(name: str, **changed: str) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        named(**changed)(folder)
        (folder / "run.toml").rename(folder / name)

    return prepare


def hard_link(name: str, target: str) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        os.link(folder / target, folder / name)

    return prepare


FIT, STUDIES = ("fit", "run.toml", "--overwrite"), ("study", "run.toml", "--overwrite")
DESIGN = ("design", "run.toml", "--overwrite")
SIMULATE = ("simulate", "run.toml", "--overwrite")
REPORT = ("report", "run.h5", "--overwrite")
CASES: dict[str, tuple[Callable[[Path], None], tuple[str, ...], str]] = {
    "a frame as the run's picture": (picture_frame("run.png"), FIT, "run.png"),
    "a frame as the study's picture": (picture_frame("s.png"), STUDIES, "s.png"),
    "a catalogue as the table of sources": (
        catalogue("run.sources.ecsv"), FIT, "run.sources.ecsv",
    ),
    "a catalogue as the study's summary": (
        catalogue("s.summary.ecsv"), STUDIES, "s.summary.ecsv",
    ),
    "a catalogue as the study's table": (catalogue("s.ecsv"), STUDIES, "s.ecsv"),
    "a frame as the chain": (hard_link("run.h5", "frame.fits"), FIT, "run.h5"),
    "a catalogue as the page": (hard_link("run.html", "stars.csv"), FIT, "run.html"),
    "a run file as the chain": (
        renamed_run_file("run.h5"), ("fit", "run.h5", "--overwrite"), "run.h5",
    ),
    "a run file as the lock": (
        renamed_run_file(".run.h5.lock"), ("fit", ".run.h5.lock", "--overwrite"), ".run.h5.lock",
    ),
    "a run file as the study's lock": (
        renamed_run_file(".s.ecsv.lock", study=STUDY),
        ("study", ".s.ecsv.lock", "--overwrite"), ".s.ecsv.lock",
    ),
    "a run file as the frame": (hard_link("frame.fits", "run.toml"), SIMULATE, "frame.fits"),
    "a PSF as the frame": (psf_image("frame.fits"), SIMULATE, "frame.fits"),
    "a run file as the design": (
        hard_link("d.ecsv", "run.toml"), DESIGN, "d.ecsv",
    ),
    "a PSF as the design's picture": (psf_image("d.fits"), DESIGN, "d.png"),
    "a chain as its page": (hard_link("run.html", "run.h5"), REPORT, "run.html"),
    "a chain as its picture": (hard_link("run.png", "run.h5"), REPORT, "run.png"),
    "a chain as a page side by side": (
        hard_link("both.html", "run.h5"),
        ("compare", "run.h5", "again.h5", "--out", "both.html", "--overwrite"), "both.html",
    ),
    "a chain as its calibration's maps": (
        hard_link("run.calibration.fits", "run.h5"),
        ("calibration", "run.h5", "--overwrite"), "run.calibration.fits",
    ),
    "a frame as the run file proposed for it": (
        hard_link("new.toml", "frame.fits"),
        ("init", "frame.fits", "--out", "new.toml", "--overwrite"), "new.toml",
    ),
    "the frame that is corrected": (
        hard_link("out.fits", "frame.fits"),
        ("correct", "frame.fits", "c.h5", "--out", "out.fits", "--overwrite"), "out.fits",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_an_input_is_never_replaced(here: Path, case: str) -> None:
    prepare, args, name = CASES[case]
    prepare(here)
    if args[0] == "design":
        text = (here / "run.toml").read_text(encoding="utf-8")
        text += "[design]\npath = 'd.ecsv'\n"
        (here / "run.toml").unlink()  # and not through a hard link
        (here / "run.toml").write_text(text, encoding="utf-8")
        if name == "d.png":
            hard_link(name, "d.fits")(here)
        else:
            hard_link(name, "run.toml")(here)
    words = (f"{name}: got a file that is read",)
    refused(here, *args, words=words)


def test_what_is_no_input_is_replaced_if_asked(here: Path) -> None:
    """The negative control: the same commands without a name in common."""
    for name in ("run.h5", *PRODUCTS, "s.ecsv", "s.summary.ecsv", "s.png"):
        foreign(here / name)
    for args, code in ((FIT, 3), ((*STUDIES, "--workers", "1"), 0), (SIMULATE, 0)):
        output = invoke(here, *args)
        assert output.code == code, output
    assert isinstance(output, Output)
    assert (here / "run.html").read_bytes().startswith(b"<!DOCTYPE html>")


def test_a_lock_is_not_taken_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("precious")
    (tmp_path / ".n.ecsv.lock").symlink_to("precious")
    with (
        pytest.raises(InputError, match=r"\.n\.ecsv\.lock: got a link"),
        only_writer(tmp_path / "n.ecsv"),
    ):
        pass
    assert (tmp_path / "precious").read_text() == "precious"


@pytest.mark.parametrize("name", ["s.ecsv", "s.summary.ecsv", "s.png", ".s.ecsv.lock"])
@pytest.mark.parametrize("option", ["", "--overwrite", "--resume"])
def test_a_study_does_not_write_through_links(here: Path, name: str, option: str) -> None:
    (here / "precious").write_text("precious")
    (here / name).unlink(missing_ok=True)
    (here / name).symlink_to("precious")
    args = ("study", "run.toml", *([option] if option else []))
    refused(here, *args, words=(f"{name}: got a link",))

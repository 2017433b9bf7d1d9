"""What a chain file keeps of its run, and that no report loses or replaces what it should not."""

import contextlib
import html
import re
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

import bayesfred as bf
from bayesfred.cli import app
from bayesfred.errors import InputError
from bayesfred.sampling.chainfile import open_chain, write_chain
from bayesfred.sampling.record import RunRecord
from bayesfred.settings.run import read_settings
from bayesfred.settings.sections import toml

RUN = """
[frame]
path = "frame.fits"
[catalogue]
path = "stars.csv"
[psf]
sigma = 2.5
[distortion]
f_terms = [[2, 0, 1, 0]]
g_terms = [[0, 1, 0, 1]]
[prior.background]
distribution = "gamma"
a = 2.0
scale = 3.0
[sampling]
seed = 7
walkers = 8
steps = 6
[simulation]
shape = [45, 60]
background = 5.0
[simulation.theta]
f_ux2 = 1e-5
[simulation.grid]
side = 2
spacing = 16.0
flux = 5e3
"""


def invoke(folder: Path, *args: str) -> tuple[int, str]:
    """Exit code and standard error of a command."""
    with contextlib.chdir(folder):
        result = CliRunner().invoke(app, list(args), catch_exceptions=False)
    return result.exit_code, result.stderr


def settings_on(page: Path) -> str:
    """The run file that a page shows, as a browser would copy it."""
    found = re.search(r"<pre[^>]*>(.*?)</pre>", page.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return html.unescape(found[1])


def text_on(page: Path) -> str:
    return html.unescape(re.sub(r"<[^>]*>", "", page.read_text(encoding="utf-8")))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a simulated frame and a short run of it."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "run.toml").write_text(RUN, encoding="utf-8")
    assert invoke(folder, "simulate", "run.toml") == (0, "")
    assert invoke(folder, "fit", "run.toml")[0] == 3  # few steps
    return folder


@pytest.mark.slow
def test_settings_on_the_page_make_the_same_draws(finished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "here"))
    (folder / "again.toml").write_text(settings_on(folder / "chains" / "run.html"))
    assert read_settings(folder / "again.toml") == read_settings(folder / "run.toml")
    assert invoke(folder, "fit", "again.toml")[0] == 3
    before, after = (open_chain(folder / "chains" / f"{name}.h5") for name in ("run", "again"))
    np.testing.assert_array_equal(before.chain, after.chain)


@pytest.mark.slow
def test_settings_of_a_resumed_run_make_its_draws(finished: Path, tmp_path: Path) -> None:
    """Those that cannot are refused, and change nothing."""
    folder = Path(shutil.copytree(finished, tmp_path / "here"))
    before = (folder / "chains" / "run.h5").read_bytes()
    (folder / "run.toml").write_text(RUN.replace("seed = 7\nwalkers = 8", "seed = 8\nwalkers = 16"))
    code, said = invoke(folder, "fit", "run.toml", "--resume")
    assert code == 2 and said.count("\n") == 1
    assert "made with seed 7, walkers 8, got seed 8, walkers 16" in said
    assert (folder / "chains" / "run.h5").read_bytes() == before
    (folder / "run.toml").write_text(RUN.replace("steps = 6", "steps = 9"))
    assert invoke(folder, "fit", "run.toml", "--resume")[0] == 3
    (folder / "again.toml").write_text(settings_on(folder / "chains" / "run.html"))
    assert invoke(folder, "fit", "again.toml")[0] == 3
    before, after = (open_chain(folder / "chains" / f"{name}.h5") for name in ("run", "again"))
    assert before.chain.shape[1:3] == (9, 8)
    np.testing.assert_array_equal(before.chain, after.chain)


def test_report_keeps_settings_notes_and_date_and_shows_the_pairs_asked_for(
    finished: Path, tmp_path: Path
) -> None:
    shutil.copy(finished / "chains" / "run.h5", tmp_path)
    assert invoke(tmp_path, "report", "run.h5", "--corner", "background, g_vy")[0] == 3
    before, after = finished / "chains" / "run.html", tmp_path / "run.html"
    assert settings_on(after) == settings_on(before)
    assert "stars.csv: 4 sources" in text_on(after)
    made = re.compile(r"frame\.fits, 45 × 60 pixels.*\d{4}-\d\d-\d\d \d\d:\d\d UTC")
    assert made.findall(text_on(after)) == made.findall(text_on(before)) != []
    assert "2 of 3 parameters" in text_on(after)
    assert "Posterior: other parameters" in text_on(after)
    assert "Posterior: other parameters" not in text_on(before)


@pytest.mark.slow
def test_report_replaces_nothing_unasked(finished: Path, tmp_path: Path) -> None:
    shutil.copy(finished / "chains" / "run.h5", tmp_path)
    for name in ("run.html", "run.png"):
        (tmp_path / name).write_text("precious")
        code, said = invoke(tmp_path, "report", "run.h5")
        assert code == 2 and said.count("\n") == 1
        assert f"{name}: exists" in said and "--overwrite" in said
        assert (tmp_path / name).read_text() == "precious"
        (tmp_path / name).unlink()
    assert invoke(tmp_path, "report", "run.h5", "--out", "other.html")[0] == 3
    made = sorted(p.name for p in tmp_path.iterdir())
    assert made == ["other.html", "other.png", "other.sources.ecsv", "run.h5"]
    assert invoke(tmp_path, "report", "run.h5", "--out", "other.html")[0] == 2
    (tmp_path / "run.html").write_text("old")
    assert invoke(tmp_path, "report", "run.h5", "--overwrite")[0] == 3
    assert "Settings" in text_on(tmp_path / "run.html")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--out", "page.txt"), ("page.txt", "NAME.html")),
        (("--out", "absent/page.html"), ("no folder absent",)),
        (("--corner", "f_ux2,nonsense"), ("corner: got nonsense", "background")),
    ],
)
def test_report_refuses_in_one_line(
    args: tuple[str, ...], words: tuple[str, ...], finished: Path, tmp_path: Path
) -> None:
    shutil.copy(finished / "chains" / "run.h5", tmp_path)
    code, said = invoke(tmp_path, "report", "run.h5", *args)
    assert code == 2 and said.count("\n") == 1
    assert all(word in said for word in words)
    assert [p.name for p in tmp_path.iterdir()] == ["run.h5"]


@pytest.mark.slow
def test_page_shows_truth_again(finished: Path, tmp_path: Path) -> None:
    chain = open_chain(finished / "chains" / "run.h5")
    assert chain.record is not None and chain.record.truth is None
    record = replace(chain.record, truth=np.array([1e-5, 0.0, 4.875]))
    write_chain(replace(chain, path=tmp_path / "run.h5", record=record))
    assert invoke(tmp_path, "report", "run.h5")[0] == 3
    assert "truth" in text_on(tmp_path / "run.html")
    assert re.search(r"<td>4\.8[78]\d*</td>", (tmp_path / "run.html").read_text(encoding="utf-8"))


# --- runs side by side ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with chains of two models, `a.h5` and `b.h5`, of one frame."""
    folder = Path(shutil.copytree(finished, tmp_path_factory.mktemp("two") / "runs"))
    other = RUN.replace("f_terms = [[2, 0, 1, 0]]", "f_terms = [[2, 0, 1, 0], [1, 0, 0, 1]]")
    for name, text in (("run", RUN), ("b", other)):
        (folder / f"{name}.toml").write_text(text)
        assert invoke(folder, "fit", f"{name}.toml", "--map-only", "--overwrite")[0] == 0
    shutil.move(folder / "chains" / "run.h5", folder / "a.h5")
    shutil.move(folder / "chains" / "b.h5", folder / "b.h5")
    return folder


@pytest.mark.slow
def test_compare_writes_a_page_if_asked_and_replaces_none(two: Path, tmp_path: Path) -> None:
    before = sorted(two.iterdir())
    assert invoke(two, "compare", "a.h5", "b.h5")[0] == 0
    assert sorted(two.iterdir()) == before
    page = tmp_path / "page.html"
    assert invoke(two, "compare", "a.h5", "b.h5", "--out", str(page))[0] == 0
    text = text_on(page)
    for words in (
        "Run 1: run",
        "Run 2: b",
        "trustworthy: ",
        "elpd",
        "log evidence",
        "(run 2 − run 1) / sd",
    ):
        assert words in text
    assert "Not in every run, but in run 2: f_vx." in text
    chains = [open_chain(two / name) for name in ("a.h5", "b.h5")]
    one, other = (chain.draws()[:, -1] for chain in chains)  # the background
    sd = max(one.std(ddof=1), other.std(ddof=1))
    difference = f"{(other.mean() - one.mean()) / sd:+.2f}".replace("-", "−")
    assert f"<td>{difference}</td>" in page.read_text(encoding="utf-8")
    page.write_text("precious")
    code, said = invoke(two, "compare", "a.h5", "b.h5", "--out", str(page))
    assert code == 2 and "page.html: exists" in said and "--overwrite" in said
    assert page.read_text() == "precious"
    assert invoke(two, "compare", "a.h5", "b.h5", "--out", str(page), "--overwrite")[0] == 0
    assert "Run 1: run" in text_on(page)


def test_badly_sampled_runs_are_not_ranked(two: Path, finished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(two, tmp_path / "here"))
    shutil.copy(finished / "chains" / "run.h5", folder / "short.h5")
    code, said = invoke(folder, "compare", "a.h5", "short.h5")
    assert code == 2 and said.count("\n") == 1
    assert "short.h5: got draws that do not represent the posterior" in said


@pytest.mark.slow
def test_runs_that_cannot_be_ranked_are_shown_side_by_side(two: Path, tmp_path: Path) -> None:
    """Of other counts, for one; the exit code says that there is no ranking."""
    folder = Path(shutil.copytree(two, tmp_path / "here"))
    (folder / "c.toml").write_text(RUN.replace("background = 5.0", "background = 6.0"))
    assert invoke(folder, "simulate", "c.toml", "--overwrite") == (0, "")
    assert invoke(folder, "fit", "c.toml")[0] == 3
    args = ("compare", "a.h5", "chains/c.h5")
    assert invoke(folder, *args)[0] == 2
    assert invoke(folder, *args, "--out", "page.html")[0] == 3
    text = text_on(folder / "page.html")
    assert "not ranked: chains/c.h5: counts: got others than those of a.h5" in text
    assert "Ranking" not in text and "Residuals" in text


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("a.h5", "b.h5", "--out", "a.h5"), ("a.h5", "expected NAME.html")),
        (("a.h5", "--out", "page.html"), ("got 1", "two models")),
        (("a.h5", "a.h5", "--out", "page.html"), ("a.h5", "twice")),
        (("a.h5", "absent.h5", "--out", "page.html"), ("absent.h5", "no such file")),
    ],
)
def test_compare_refuses_in_one_line(
    args: tuple[str, ...], words: tuple[str, ...], two: Path
) -> None:
    before = {path: path.read_bytes() for path in two.glob("*.h5")}
    code, said = invoke(two, "compare", *args)
    assert code == 2 and said.count("\n") == 1
    assert all(word in said for word in words)
    assert {path: path.read_bytes() for path in two.glob("*.h5")} == before
    assert not (two / "page.html").exists()


# --- the record -----------------------------------------------------------------------------------


def test_record_survives_a_file(finished: Path, tmp_path: Path) -> None:
    """Texts of any script and length, no notes, and none at all; a file without one is read."""
    chain = open_chain(finished / "chains" / "run.h5")
    record = RunRecord("ночь", "星.fits", "a = 'ü'\n" * 6000, ("one", "", "zwei"), np.arange(3.0))
    for given in (record, RunRecord(), None):
        write_chain(replace(chain, path=tmp_path / "run.h5", record=given))
        found = open_chain(tmp_path / "run.h5").record
        if given is None:
            assert found is None
            continue
        assert found is not None
        for name in ("title", "frame", "settings", "notes", "made"):
            assert getattr(found, name) == getattr(given, name)
        np.testing.assert_array_equal(found.truth, given.truth)


def test_record_is_kept_by_sample_and_by_its_resumption(finished: Path, tmp_path: Path) -> None:
    chain = open_chain(finished / "chains" / "run.h5")
    path, record = tmp_path / "run.h5", RunRecord("by hand", truth=np.array([1e-5, 0.0, 5.0]))
    given = {"seed": 1, "walkers": 8, "path": path, "progress": False}
    bf.sample(chain.posterior(), chain.estimate, steps=4, record=record, **given)
    resumed = bf.sample(chain.posterior(), chain.estimate, steps=5, resume=True, **given)
    for found in (resumed, open_chain(path)):
        assert found.record is not None and found.record.title == "by hand"
    short = RunRecord(truth=np.zeros(2))
    with pytest.raises(InputError, match="record: got a truth of 2 parameters, expected 3"):
        bf.sample(chain.posterior(), chain.estimate, seed=1, steps=4, record=short, progress=False)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"settings": "x" * 60_001}, "settings: got 60001 bytes"),
        ({"notes": ("a" * 30_000, "b", "c")}, "notes: got 90000 bytes"),
        ({"title": "\udcff"}, "title: got characters that are not Unicode"),
        ({"truth": np.array([np.nan])}, "truth: got other than"),
        ({"truth": np.zeros((2, 2))}, "truth: got other than"),
        ({"made": "yesterday"}, "made: got 'yesterday'"),
        ({"made": "2026-11-22T04:00:00"}, "expected a date and time in UTC"),
    ],
)
def test_bad_records_are_refused(fields: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        RunRecord(**fields)  # type: ignore[arg-type]


def test_a_stranger_s_record_is_refused_or_escaped(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chain = open_chain(finished / "chains" / "run.h5")
    evil = "</pre><script>alert(1)</script>\u202e\x00\x1b"
    with monkeypatch.context() as patch:  # a file that says what no record may say
        patch.setattr(RunRecord, "__post_init__", lambda self: None)
        bad = RunRecord(truth=np.zeros(4)), RunRecord(made=evil)
        for k, record in enumerate(bad):
            write_chain(replace(chain, path=tmp_path / f"{k}.h5", record=record))
    for k in range(len(bad)):
        code, said = invoke(tmp_path, "report", f"{k}.h5")
        assert code == 2 and said.count("\n") == 1 and f"{k}.h5: " in said
    record = RunRecord(evil, evil, f"{evil}\n{evil}", (evil,))
    write_chain(replace(chain, path=tmp_path / "run.h5", record=record))
    assert invoke(tmp_path, "report", "run.h5")[0] == 3
    page = (tmp_path / "run.html").read_text(encoding="utf-8")
    assert "<script" not in page and page.count("</pre>") == 1
    assert not set(page) & {"\u202e", "\x00", "\x1b"}


def test_record_is_sealed(finished: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(finished / "chains" / "run.h5", tmp_path))
    content = path.read_bytes()
    assert content.count(b"stars.csv: 4 sources") == 1
    path.write_bytes(content.replace(b"stars.csv: 4 sources", b"stars.csv: 9 sources"))
    with pytest.raises(InputError, match="another content than its seal says"):
        open_chain(path)


def test_run_file_of_any_strings_is_written_and_read_back(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text(RUN)
    run = read_settings(path)
    for text in (
        'a"b\\c',
        "tab\tline\nreturn\r\x07\x7f",
        "\u202e\u00a0\u00ad é 星 \U0001f600\U000e0001",
    ):
        changed = run.model_copy(update={"frame": run.frame.model_copy(update={"path": text})})
        changed = changed.model_copy(update={"prior": {text: run.prior["background"]}})
        written = toml(changed)
        assert all(line.isprintable() for line in written.split("\n"))
        path.write_text(written, encoding="utf-8")
        assert read_settings(path) == changed


def test_files_hold_records_as_they_hold_other_objects(finished: Path) -> None:
    with h5py.File(finished / "chains" / "run.h5") as file:
        assert file["record"].attrs["kind"] == b"run_record"
        assert file["record"].attrs["title"] == b"run"

"""`fit --map-only` and `demo --map-only`: whole runs that are not sampled."""

import shutil
from pathlib import Path

import pytest
from test_cli import Output, assert_refused, finished, folder, invoke, simulated, snapshot

from bayesfred.analysis.diagnostics import diagnose
from bayesfred.analysis.verify import verify
from bayesfred.sampling.chainfile import open_chain

__all__ = ["finished", "folder", "simulated"]  # fixtures


@pytest.fixture(scope="module")
def mapped(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Output]:
    """A copy of the folder, and what a fit without sampling left there."""
    folder = shutil.copytree(simulated, tmp_path_factory.mktemp("mapped") / "run")
    return folder, invoke(folder, "fit", "run.toml", "--map-only")


def test_everything_is_written_and_the_verdict_says_what_was_done(
    mapped: tuple[Path, Output],
) -> None:
    folder, output = mapped
    assert output.code == 0
    verdict = output.stdout.splitlines()[-1]
    assert verdict.startswith("trustworthy: The model fits the counts")
    assert "Not sampled: errors are those of the information at the maximum" in verdict
    assert {"run.h5", "run.html", "run.png"} <= {path.name for path in folder.iterdir()}
    page = (folder / "run.html").read_text(encoding="utf-8")
    assert "independent, of the Laplace approximation" in page
    assert "Median and middle 68 %" not in page and ">nan<" not in page
    found = diagnose(open_chain(folder / "run.h5"))
    assert found.sampled_well is None and found.trustworthy and found.at_maximum
    assert found.approximation.efficiency > 0.9


def test_errors_are_those_of_the_sampled_run(
    mapped: tuple[Path, Output], finished: tuple[Path, Output]
) -> None:
    """1000 draws against some 200 effective ones: errors are known to 2 and 5 %."""
    not_sampled = open_chain(mapped[0] / "run.h5").summary()
    sampled = open_chain(finished[0] / "run.h5").summary()
    shift = (not_sampled["mean"] - sampled["mean"]) / sampled["sd"]
    assert abs(shift).max() < 4 * (1 / 200 + 1 / 1000) ** 0.5
    ratio = not_sampled["sd"] / sampled["sd"]
    assert abs(ratio - 1).max() < 4 * (0.5 / 200 + 0.5 / 1000) ** 0.5


@pytest.mark.slow
def test_report_verify_and_compare(
    mapped: tuple[Path, Output], finished: tuple[Path, Output], tmp_path: Path
) -> None:
    folder = shutil.copytree(mapped[0], tmp_path / "run")
    for kind in ("html", "png", "sources.ecsv"):
        (folder / f"run.{kind}").unlink()
    again = invoke(folder, "report", "run.h5")
    assert again.code == 0 and (folder / "run.html").exists()
    assert again.stdout.splitlines()[-1] == mapped[1].stdout.splitlines()[-1]
    checks = verify(folder / "run.h5")
    assert [check.what for check in checks] == [
        "file", "posterior", "MAP's log-probability", "MAP", "covariance", "draws", "not checked",
    ]  # fmt: skip
    assert all(check.holds for check in checks)
    assert "differ by at most 0 standard deviations" in checks[-2].finding
    shutil.copy(finished[0] / "run.h5", folder / "sampled.h5")
    compared = invoke(folder, "compare", "run.h5", "sampled.h5")
    assert compared.code == 0 and "chosen: " in compared.stdout


@pytest.mark.slow
def test_nothing_is_replaced_or_resumed_unasked(
    mapped: tuple[Path, Output], tmp_path: Path
) -> None:
    folder = shutil.copytree(mapped[0], tmp_path / "run")
    before = snapshot(folder)
    assert_refused(invoke(folder, "fit", "run.toml", "--map-only"), "run.h5", "--overwrite")
    assert_refused(
        invoke(folder, "fit", "run.toml", "--map-only", "--resume"), "--map-only", "--resume"
    )
    assert_refused(invoke(folder, "fit", "run.toml", "--resume"), "run.h5", "Laplace", "overwrite")
    assert snapshot(folder) == before
    text = (folder / "run.toml").read_text(encoding="utf-8")
    quick = text.replace("target_ess = 200", "steps = 3")
    (folder / "run.toml").write_text(quick, encoding="utf-8")
    assert invoke(folder, "fit", "run.toml", "--overwrite").code == 3
    assert open_chain(folder / "run.h5").method == "mcmc"

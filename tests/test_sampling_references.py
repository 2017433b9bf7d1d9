"""Fresh runs against the reference posteriors in `chains/reference/`.

Differences are judged by the Monte Carlo errors of both.
"""

import importlib.util
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from test_model import LIMIT

from bayesfred.commands import simulate_frame
from bayesfred.io.frames import read_frame
from bayesfred.model.posterior import Posterior
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.sampler import sample

FOLDER = ROOT / "chains" / "reference"


def script() -> Any:
    """The module that makes the references."""
    spec = importlib.util.spec_from_file_location("make_references", FOLDER / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


make = script()
REFERENCES = {
    path.stem: json.loads(path.read_text(encoding="utf-8"))
    for path in sorted(FOLDER.glob("*.json"))
}


def run(posterior: Posterior, folder: Path) -> Chain:
    return sample(posterior, path=folder / "run.h5", seed=2, target_ess=500, progress=False)


def worst(reference: Any, chain: Chain) -> float:
    """Largest difference of a mean or a standard deviation, in Monte Carlo errors."""
    z = []
    for name, fresh in make.summary(chain).items():
        for what in ("mean", "sd"):
            kept = reference["parameters"][name][what]
            z.append(
                (fresh[what]["value"] - kept["value"])
                / np.hypot(fresh[what]["error"], kept["error"])
            )
    return float(np.abs(z).max())


@pytest.mark.parametrize("name", make.NAMES)
def test_references_are_whole(name: str) -> None:
    reference, posterior = REFERENCES[name], make.posterior(name)
    assert (FOLDER / f"{name}.json").stat().st_size < 300_000
    assert reference["counts_sha256"] == make.counts_hash(
        posterior.counts
    )  # the frame is drawn again as it was
    assert (
        tuple(reference["draws_columns"])
        == tuple(reference["parameters"])
        == posterior.parameter_names
    )
    assert min(reference["effective_draws"].values()) >= 10_000
    draws = np.array(reference["draws"])
    assert draws.shape == (500, posterior.n_parameters)
    for values, stated in zip(draws.T, reference["parameters"].values(), strict=True):
        assert abs(values.mean() - stated["mean"]["value"]) < LIMIT * stated["sd"][
            "value"
        ] / np.sqrt(500)
        assert abs(values.std() / stated["sd"]["value"] - 1.0) < LIMIT / np.sqrt(1000)


@pytest.mark.parametrize("name", make.NAMES)
def test_a_run_file_draws_its_frame_again(name: str, tmp_path: Path) -> None:
    shutil.copy(FOLDER / f"{name}.toml", tmp_path)
    simulate_frame(tmp_path / f"{name}.toml")
    counts = read_frame(tmp_path / f"{name}.fits").counts
    assert make.counts_hash(counts) == REFERENCES[name]["counts_sha256"]


@pytest.mark.parametrize(
    "name",
    [
        "paper",
        pytest.param("faint", marks=pytest.mark.statistics),
        pytest.param("free", marks=pytest.mark.statistics),
    ],
)
def test_a_fresh_run_agrees_with_the_reference(name: str, tmp_path: Path) -> None:
    assert worst(REFERENCES[name], run(make.posterior(name), tmp_path)) < LIMIT


def test_a_kernel_without_its_determinant_does_not(tmp_path: Path) -> None:
    assert (
        worst(REFERENCES["paper"], run(make.posterior("paper", conserve_flux=False), tmp_path))
        > LIMIT
    )

"""Verification: a change of a chain file that was sealed again is found and named."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from test_model import make_model, make_posterior, make_truth
from test_sampling_chain import reseal, run

from bayesfred.analysis.verify import Check, verify
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import fingerprint

STEPS = 15
CHECKS = (
    "file",
    "posterior",
    "log-probability",
    "MAP's log-probability",
    "MAP",
    "covariance",
    "first steps",
    "numbers",
    "random state",
    "burn-in",
    "not checked",
)


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    rng = np.random.default_rng(80)
    model = make_model(tolerance=1e-8)
    return make_posterior(model, make_truth(model, rng), rng)[0]


@pytest.fixture(scope="module")
def estimate(posterior: Posterior) -> MapEstimate:
    return find_map(posterior)


@pytest.fixture(scope="module")
def whole(
    posterior: Posterior, estimate: MapEstimate, tmp_path_factory: pytest.TempPathFactory
) -> Chain:
    return run(
        posterior, estimate, tmp_path_factory.mktemp("whole") / "chain.h5", STEPS, walkers=48
    )


@pytest.fixture
def path(whole: Chain, tmp_path: Path) -> Path:
    return Path(shutil.copy(whole.path, tmp_path))


def failed(checks: list[Check]) -> set[str]:
    assert [check.what for check in checks] == list(CHECKS)
    return {check.what for check in checks if not check.holds}


def finding(checks: list[Check], what: str) -> str:
    return next(check.finding for check in checks if check.what == what)


def test_a_run_holds(whole: Chain) -> None:
    checks = verify(whole.path)
    assert failed(checks) == set()
    assert finding(checks, "first steps") == "10 replayed from seed 1: equal bit for bit"
    assert finding(checks, "log-probability") == "1000 of 1440 draws: differ by at most 0"
    moves = whole.accepted.sum()
    assert (
        finding(checks, "numbers")
        == f"15 steps of 2 x 48 walkers, {moves} moves accepted, {moves} counted again"
    )
    assert whole.path.read_bytes()[-65:-1].decode() in finding(checks, "file")
    assert finding(verify(whole.path, every_draw=True), "log-probability").startswith(
        "1440 of 1440 draws"
    )


def add(file: h5py.File, name: str, place: object, value: float) -> None:
    values = file[name][()]
    values[place] += value
    file[name][()] = values


Change = Callable[[h5py.File], object]
CHANGES: dict[str, tuple[Change, set[str]]] = {
    "a late draw": (lambda f: add(f, "ensemble_1/chain", (-1, 4, 12), 1e-3), {"log-probability"}),
    "an early draw": (
        lambda f: add(f, "ensemble_1/chain", (3, 4, 12), 1e-3),
        {"log-probability", "first steps"},
    ),
    "a log-probability": (
        lambda f: add(f, "ensemble_0/log_prob", (12, 3), 1e-3),
        {"log-probability"},
    ),
    "no log-probability": (
        lambda f: add(f, "ensemble_0/log_prob", (12, 3), np.nan),
        {"log-probability"},
    ),
    "the moves": (lambda f: add(f, "ensemble_0/accepted", 3, 1), {"numbers"}),
    "the burn-in": (lambda f: f.attrs.update(burn_in=3), {"burn-in"}),
    "the random state": (
        lambda f: f["ensemble_1"].attrs.update(random_state_2=17),
        {"random state"},
    ),
    "the seed": (lambda f: f.attrs.update(seed=2), {"first steps", "numbers", "random state"}),
    "the MAP's value": (
        lambda f: f["estimate"].attrs.update(log_prob=-1.0),
        {"MAP's log-probability"},
    ),
    "the MAP": (
        lambda f: add(f, "estimate/params", 12, 0.01),
        {"MAP's log-probability", "MAP", "first steps", "numbers"},
    ),
    "the covariance": (
        lambda f: add(f, "estimate/covariance", (12, 12), 1e-3),
        {"covariance", "first steps", "numbers"},
    ),
    "a count": (
        lambda f: add(f, "posterior/counts", (30, 37), 40.0),
        {"log-probability", "MAP's log-probability", "MAP"},
    ),
    "a catalogued flux": (
        lambda f: add(f, "posterior/model/sources/flux", 4, 100.0),
        {"log-probability", "MAP's log-probability", "MAP"},
    ),
    "a prior": (
        lambda f: f["posterior/prior/background"].attrs.update(parameters=[0.0, 5.0]),
        {"log-probability", "MAP's log-probability"},
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_was_changed_is_found(path: Path, name: str) -> None:
    change, wrong = CHANGES[name]
    with h5py.File(path, "a") as file:
        change(file)
    with pytest.raises(InputError, match="seal"):
        verify(path)
    reseal(path)
    found = failed(verify(path, every_draw=True))
    follow = {"first steps", "numbers", "random state", "covariance"}
    assert found - follow == wrong - follow
    assert found >= wrong


def test_an_estimate_that_no_run_can_have_started_from_is_found(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["estimate/covariance"][()] = -file["estimate/covariance"][()]
    reseal(path)
    with pytest.raises(InputError, match="a covariance that is none"):
        verify(path)


def test_a_posterior_that_is_not_rebuilt_as_it_was_is_found(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["posterior/noise"].attrs["colour"] = 1.0  # which nothing reads
    reseal(path)
    checks = verify(path)
    assert (
        failed(checks) == {"posterior"}
        and finding(checks, "posterior") == "differs when rebuilt: noise"
    )


def test_a_maximum_that_was_not_found_is_not_asked_for(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    off = estimate.params + 0.3 * np.sqrt(np.diag(estimate.covariance))
    given = replace(estimate, params=off, log_prob=posterior.log_prob(off), at_maximum=False)
    checks = verify(run(posterior, given, tmp_path / "chain.h5", 3).path)
    assert all(check.holds for check in checks)
    assert finding(checks, "MAP") == "was stored as not at the maximum"
    given = replace(given, at_maximum=True)
    checks = verify(run(posterior, given, tmp_path / "other.h5", 3).path)
    assert failed(checks) >= {"MAP"}


def test_a_file_replaced_meanwhile_is_not_mixed_with_the_one_that_is_checked(
    path: Path, whole: Chain, monkeypatch: pytest.MonkeyPatch
) -> None:
    digest = whole.path.read_bytes()[-65:-1].decode()
    told = finding(verify(path), "file")

    def replaced(posterior: Posterior) -> dict[str, str]:
        path.write_bytes(b"another file")
        return fingerprint(posterior)

    monkeypatch.setattr("bayesfred.analysis.verify.fingerprint", replaced)
    checks = verify(path)
    assert failed(checks) == set() and finding(checks, "file") == told == f"SHA-256 {digest}"

"""Runs and their files: resuming, interrupts, damage, and what others can read of them."""

import math
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import arviz_stats
import emcee
import filelock
import h5py
import numba as nb
import numpy as np
import pytest
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from scipy.signal import lfilter
from test_model import EVERYTHING, make_model, make_posterior, make_truth
from threadpoolctl import threadpool_limits

from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.io import hdf5_checks
from bayesfred.model.noise import BackgroundNoise, PoissonNoise
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import fingerprint, open_chain, write_chain
from bayesfred.sampling.checkpoints import Checkpoints, in_memory
from bayesfred.sampling.convergence import convergence
from bayesfred.sampling.datatree import source_of_pixels
from bayesfred.sampling.ensembles import DE_SHARE, adapted, moves_after
from bayesfred.sampling.sampler import Run, sample
from bayesfred.sampling.stopping import checks, forgetting, sufficient

Floats = NDArray[np.float64]

TOTAL = 12


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    rng = np.random.default_rng(50)
    model = make_model(tolerance=1e-8)
    return make_posterior(model, make_truth(model, rng), rng)[0]


@pytest.fixture(scope="module")
def estimate(posterior: Posterior) -> MapEstimate:
    return find_map(posterior)


def run(
    posterior: Posterior,
    estimate: MapEstimate | None,
    path: Path,
    steps: int | None = TOTAL,
    **options: Any,
) -> Chain:
    settings: dict[str, Any] = {
        "seed": 1,
        "ensembles": 2,
        "walkers": 8,
        "progress": False,
        **options,
    }
    return sample(posterior, estimate, path=path, steps=steps, **settings)


Through = Callable[[Callable[[ArrayLike], Floats], ArrayLike], Floats]


class Watched(TargetDensity):
    """A density whose `log_prob` is called by a function of the test."""

    def __init__(self, real: TargetDensity, through: Through) -> None:
        self.real, self.through = real, through

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return self.real.parameter_names

    @property
    def support(self) -> tuple[Floats, Floats]:
        return self.real.support

    def log_prob(self, params: ArrayLike) -> Floats:
        return self.through(self.real.log_prob, params)

    def gradient(self, params: ArrayLike) -> Floats:
        return self.real.gradient(params)

    def information(self, params: ArrayLike) -> Floats:
        return self.real.information(params)


def saving(posterior: Posterior, path: Path, **options: Any) -> Checkpoints:
    """Checkpoints of a watched run, whose file holds the posterior itself."""
    return Checkpoints(
        lambda chain: write_chain(replace(chain, path=path, density=posterior)), **options
    )


def watched(
    posterior: Posterior,
    estimate: MapEstimate,
    path: Path,
    through: Through,
    steps: int | None = TOTAL,
    checkpoints: Checkpoints | None = None,
    *,
    resume: bool = False,
) -> Chain:
    """As `run`, with log-probabilities that a function of the test computes or spoils."""
    target, checkpoints = Watched(posterior, through), checkpoints or saving(posterior, path)
    with threadpool_limits(1, user_api="blas"):
        if resume:
            running = Run.resumed(target, open_chain(path))
        else:
            running = Run(target, estimate, 1, ensembles=2, walkers=8)
        return running.until(1000.0, steps, checkpoints, show=False)


@pytest.fixture(scope="module")
def whole(
    posterior: Posterior, estimate: MapEstimate, tmp_path_factory: pytest.TempPathFactory
) -> Chain:
    """A run that nothing disturbed."""
    return run(posterior, estimate, tmp_path_factory.mktemp("whole") / "chain.h5")


def draws_of(chain: Chain) -> Mapping[str, Any]:
    return {
        "chain": chain.chain.tobytes(),
        "log_prob": chain.log_prob.tobytes(),
        "accepted": chain.accepted.tobytes(),
    }


def assert_same_file(a: Path, b: Path) -> None:
    """Every dataset and attribute of two HDF5 files is the same, bit by bit."""

    def content(path: Path) -> dict[str, Any]:
        found: dict[str, Any] = {}

        def add(name: str, item: Any) -> None:
            found[name] = item[()].tobytes() if isinstance(item, h5py.Dataset) else None
            found.update(
                {f"{name}@{key}": np.asarray(value).tolist() for key, value in item.attrs.items()}
            )

        with h5py.File(path, "r") as file:
            add("/", file)
            file.visititems(add)
        return found

    first, second = content(a), content(b)
    assert first.keys() == second.keys()
    assert [key for key in first if first[key] != second[key] and first[key] == first[key]] == []


def reseal(path: Path) -> None:
    """Give a file that was edited the seal that its content asks for, as anybody can."""
    content = path.read_bytes().rsplit(b"\nbayesfred sha256", 1)[0]
    path.write_bytes(content + hdf5_checks.seal(content))


# --- runs -----------------------------------------------------------------------------------------


def test_a_chain_has_the_shapes_it_says(
    posterior: Posterior, estimate: MapEstimate, whole: Chain
) -> None:
    d = posterior.n_parameters
    assert (
        whole.chain.shape == (2, TOTAL, 8, d)
        and whole.log_prob.shape == (2, TOTAL, 8)
        and whole.accepted.shape == (2, 8)
    )
    assert whole.parameter_names == posterior.parameter_names and whole.seed == 1
    assert (
        whole.draws().shape == (2 * (TOTAL - whole.burn_in) * 8, d)
        and 0 <= whole.burn_in <= TOTAL // 2
    )
    assert np.array_equal(whole.log_prob[1, -1], posterior.log_prob(whole.chain[1, -1]))
    moved = np.any(np.diff(whole.chain, axis=1) != 0, axis=-1).sum(axis=1)
    assert np.all(
        (whole.accepted == moved) | (whole.accepted == moved + 1)
    )  # the first step's is not in the chain
    assert whole.accepted.mean() > 0.7 * TOTAL
    assert np.array_equal(whole.estimate.params, estimate.params)
    assert {"bayesfred", "emcee", "numba", "numpy", "scipy", "python"} <= set(whole.versions)
    assert not np.array_equal(whole.chain[0], whole.chain[1])


def test_the_file_gives_the_chain_back(whole: Chain) -> None:
    again = open_chain(str(whole.path))
    assert draws_of(again) == draws_of(whole)
    assert (again.parameter_names, again.burn_in, again.seed) == (
        whole.parameter_names,
        whole.burn_in,
        whole.seed,
    )
    assert again.versions == whole.versions and again.estimate.message == whole.estimate.message
    assert fingerprint(again.posterior()) == fingerprint(whole.posterior())
    assert again.random_states[1][1].tolist() == whole.random_states[1][1].tolist()


def test_a_chain_holds_the_posterior_that_was_sampled(
    posterior: Posterior, estimate: MapEstimate, whole: Chain, tmp_path: Path
) -> None:
    """Whatever file takes the place of the chain's, and where none is left."""
    path = Path(shutil.copy(whole.path, tmp_path))
    chain = open_chain(path)
    other = Posterior(posterior.model, posterior.counts + 1.0)
    replacing = run(other, estimate, path, 2, overwrite=True)
    before, after = (fingerprint(p) for p in (posterior, other))
    assert before["counts"] != after["counts"]
    assert fingerprint(chain.posterior()) == before and chain.posterior() is chain.posterior()
    assert fingerprint(replacing.posterior()) == after  # negative control: the file did change
    assert fingerprint(open_chain(path).posterior()) == after
    path.unlink()
    assert fingerprint(chain.posterior()) == before


def test_the_seal_is_checked_once(whole: Chain, tmp_path: Path) -> None:
    """A pipe can be read once: the chain, its posterior and its random numbers come with it."""
    chain = open_chain(whole.path)
    assert chain.posterior() is not whole.posterior() and chain.random_states
    chain.path.rename(moved := tmp_path / "moved.h5")
    try:
        resumed = Run.resumed(chain.posterior(), chain)
        assert resumed.steps[-1].random[0][1].tolist() == whole.random_states[0][1].tolist()
        assert chain.posterior().log_prob(chain.estimate.params) == chain.estimate.log_prob
    finally:
        moved.rename(whole.path)


def test_sampling_in_memory_is_sampling_to_a_file(
    posterior: Posterior, estimate: MapEstimate, whole: Chain, tmp_path: Path
) -> None:
    settings: dict[str, Any] = {"seed": 1, "ensembles": 2, "walkers": 8, "progress": False}
    before = os.getcwd()
    os.chdir(tmp_path)
    try:
        chain = sample(posterior, estimate, steps=TOTAL, **settings)
    finally:
        os.chdir(before)
    assert draws_of(chain) == draws_of(whole) and chain.burn_in == whole.burn_in
    assert chain.path is None and chain.posterior() is posterior
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="sampling: path: got none with resume or overwrite"):
        sample(posterior, estimate, resume=True, **settings)


def test_a_density_that_no_file_can_hold_is_refused_before_sampling(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    def never(log_prob: Any, params: ArrayLike) -> Floats:
        raise AssertionError("it was evaluated")

    with pytest.raises(InputError, match=r"files cannot hold, .* or sample it in memory"):
        sample(Watched(posterior, never), path=tmp_path / "chain.h5", seed=1, progress=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("burn_in", [3, 4])  # an even and an odd number of steps
def test_an_ensemble_is_a_chain_for_arviz(whole: Chain, burn_in: int) -> None:
    chain = replace(whole, burn_in=burn_in)
    tree = chain.to_datatree()
    steps = TOTAL - burn_in
    assert (
        tree["posterior"]["background"].shape == tree["sample_stats"]["lp"].shape == (2, 8 * steps)
    )
    early = (steps + 1) // 2  # of the first walker
    for name, k in (("f_ux", 0), ("background", 12)):
        series, own = tree["posterior"][name].values[1], chain.chain[1, burn_in:, :, k]
        assert np.array_equal(series[:early], own[:early, 0])
        assert np.array_equal(series[-(steps - steps // 2) :], own[steps // 2 :, -1])
        assert np.array_equal(np.sort(series), np.sort(own, axis=None))
    lp = tree["sample_stats"]["lp"].values[1]
    assert np.array_equal(lp[:early], chain.log_prob[1, burn_in : burn_in + early, 0])
    rhat, bulk, tail = convergence(chain.chain[:, burn_in:])
    theirs = arviz_stats.rhat(tree)
    for k, name in enumerate(chain.parameter_names):
        assert float(theirs[name]) == pytest.approx(rhat[k], rel=1e-6)
        stored = tree["posterior"][name].attrs
        assert [stored[key] for key in ("rhat", "ess_bulk", "ess_tail")] == [
            rhat[k], bulk[k], tail[k],
        ]  # fmt: skip
    assert tree["posterior"]["f_ux"].attrs["units"] == "px^-1"


@pytest.mark.parametrize(("phi", "within"), [(0.0, 0.1), (0.5, 0.15), (0.9, 0.35)])
def test_arviz_counts_the_correlation_of_steps(whole: Chain, phi: float, within: float) -> None:
    """160 steps of 128 walkers that follow an AR(1) process: (1 - phi) / (1 + phi) of the draws.

    An effective sample size is known to about 3 % for phi = 0.5 and to 9 % for 0.9. In the order
    of the steps arviz finds 3 and 18 times too many: the negative control.
    """
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((4, 400, 32, 1)) * (1 - phi**2) ** 0.5
    steps = lfilter([1.0], [1.0, -phi], noise, axis=1)[:, -160:]
    right = steps.size * (1 - phi) / (1 + phi)
    chain = replace(
        whole, density=SimpleNamespace(parameter_names=("f_ux",)), chain=steps,
        log_prob=steps[..., 0], burn_in=0,
    )  # fmt: skip
    tree = chain.to_datatree()
    ess = float(arviz_stats.ess(tree)["f_ux"])
    assert ess == pytest.approx(right, rel=within)
    assert tree["posterior"]["f_ux"].attrs["ess_bulk"] == pytest.approx(right, rel=within)
    wrong = xr.Dataset({"f_ux": (("chain", "draw"), steps.reshape(4, -1))})
    if phi:
        assert float(arviz_stats.ess(wrong)["f_ux"]) > 2.5 * right


def test_the_tree_holds_the_frame_and_the_likelihood_by_source(whole: Chain) -> None:
    posterior = whole.posterior()
    tree = whole.to_datatree(log_likelihood=True)
    observed, known = tree["observed_data"], tree["constant_data"]
    used = posterior.mask
    assert np.array_equal(observed["mask"], used)
    assert np.array_equal(observed["counts"].values[used], posterior.counts[used])
    assert np.isnan(observed["counts"].values[~used]).all()
    assert float(observed["u"][0]) == -0.5 * (used.shape[1] - 1)
    assert np.array_equal(known["flux"], posterior.model.sources.flux)
    assert float(known["psf_sigma"]) == posterior.model.psf.sigma
    found = tree["log_likelihood"]["counts"]
    assert found.dims == ("chain", "draw", "source")
    draws = np.stack([tree["posterior"][name].values for name in whole.parameter_names], axis=-1)
    draws = draws[:, found["draw"].values].reshape(-1, draws.shape[-1])
    total = posterior.log_prob(draws) - posterior.log_prior(draws)
    np.testing.assert_allclose(found.values.sum(axis=2).ravel(), total, rtol=1e-10)


def test_a_pixel_belongs_to_the_source_that_lights_it(whole: Chain) -> None:
    """Against images of every source alone."""
    posterior, params = whole.posterior(), whole.estimate.params
    model, owner = posterior.model, source_of_pixels(posterior, params)
    s, theta = model.sources, params[: model.distortion.n_terms]
    alone = np.stack([
        replace(model, sources=SourceCatalog(s.x[k : k + 1], s.y[k : k + 1], s.flux[k : k + 1]))
        .expected_counts(theta)[posterior.mask]
        for k in range(len(s))
    ])  # fmt: skip
    lit = owner < len(s)
    clear = np.sort(alone, axis=0)[-1] > 1.5 * np.sort(alone, axis=0)[-2]
    assert lit.any() and (~lit).any()
    assert np.array_equal(owner[lit & clear], alone.argmax(axis=0)[lit & clear])
    assert alone.max(axis=0)[~lit].max() < alone.max() * 0.05


def test_emcee_reads_the_file(whole: Chain) -> None:
    for k in range(2):
        backend = emcee.backends.HDFBackend(str(whole.path), name=f"ensemble_{k}", read_only=True)
        assert (backend.iteration, backend.shape) == (TOTAL, (8, 13))
        assert np.array_equal(backend.get_chain(), whole.chain[k])
        assert np.array_equal(backend.get_log_prob(), whole.log_prob[k])
        assert np.array_equal(backend.accepted, whole.accepted[k])
        np.random.RandomState().set_state(backend.random_state)


def test_resuming_anywhere_changes_no_bit(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    """10 stops at random, on 1 and 2 threads, against one run that never stopped."""
    total, before = 40, nb.get_num_threads()
    whole = run(posterior, estimate, tmp_path / "whole.h5", total)
    stops = np.random.default_rng(52).choice(total - 1, 10, replace=False) + 1
    try:
        for threads in range(1, min(2, nb.config.NUMBA_NUM_THREADS) + 1):
            nb.set_num_threads(threads)
            for stop in stops:
                path = tmp_path / f"{threads}-{stop}.h5"
                run(posterior, estimate, path, int(stop))
                chain = run(posterior, None, path, total, resume=True)
                for name in ("chain", "log_prob", "accepted"):
                    assert np.array_equal(getattr(chain, name), getattr(whole, name)), (
                        threads,
                        stop,
                        name,
                    )
                assert_same_file(path, whole.path)
    finally:
        nb.set_num_threads(before)


def test_arviz_and_netcdf_read_the_chain(whole: Chain, tmp_path: Path) -> None:
    tree = open_chain(whole.path).to_datatree()
    tree.to_netcdf(tmp_path / "chain.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "chain.nc", engine="h5netcdf") as read:
        assert set(read["posterior"].data_vars) == set(whole.parameter_names)
        for name in whole.parameter_names:
            assert np.array_equal(read["posterior"][name], tree["posterior"][name])
        assert np.array_equal(read["sample_stats"]["lp"], tree["sample_stats"]["lp"])
        assert float(arviz_stats.ess(read)["background"]) > 10


@pytest.mark.parametrize("stops", [(1,), (5,), (11,), (2, 7)])
def test_a_resumed_run_is_the_uninterrupted_one(
    posterior: Posterior,
    estimate: MapEstimate,
    whole: Chain,
    tmp_path: Path,
    stops: tuple[int, ...],
) -> None:
    path = tmp_path / "chain.h5"
    for stop in (*stops, TOTAL):
        chain = run(posterior, estimate, path, stop, resume=True)
        assert chain.chain.shape[1] == stop
    assert draws_of(chain) == draws_of(whole)
    assert_same_file(path, whole.path)


def test_another_state_of_the_random_numbers_is_seen(
    posterior: Posterior, whole: Chain, tmp_path: Path
) -> None:
    """What tests of resuming rest on: it is not enough that the positions are right."""
    path = tmp_path / "chain.h5"
    run(posterior, whole.estimate, path, 5)
    with h5py.File(path, "a") as file:
        file["ensemble_1"].attrs["random_state_2"] = (
            file["ensemble_1"].attrs["random_state_2"] + 2
        ) % 624
    reseal(path)
    resumed = run(posterior, None, path, resume=True)
    assert np.array_equal(resumed.chain[0], whole.chain[0]) and not np.array_equal(
        resumed.chain[1], whole.chain[1]
    )


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"seed": 99}, "made with seed 1, got seed 99"),
        ({"ensembles": 3}, "made with ensembles 2, got ensembles 3"),
        ({"walkers": 10, "seed": 2}, "made with seed 1, walkers 8, got seed 2, walkers 10"),
    ],
)
def test_other_numbers_than_those_of_the_run_are_refused(
    posterior: Posterior, whole: Chain, tmp_path: Path, changed: dict[str, int], words: str
) -> None:
    """They were ignored. The estimate is not needed: that in the file holds."""
    path = tmp_path / "chain.h5"
    run(posterior, whole.estimate, path, 5)
    before = path.read_bytes()
    with pytest.raises(InputError, match=f"chain.h5: the run was {words}, expected the same"):
        run(posterior, None, path, resume=True, **changed)
    assert path.read_bytes() == before
    assert draws_of(run(posterior, None, path, resume=True)) == draws_of(whole)


def test_the_versions_of_every_step_are_kept(
    posterior: Posterior, whole: Chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They used to become today's, those of the steps made before too."""
    path, first = tmp_path / "chain.h5", whole.versions
    run(posterior, whole.estimate, path, 3)
    other, another = {**first, "numpy": "9.9"}, {**first, "numpy": "10.0", "wheel": "1"}
    for total, here in ((3, other), (5, other), (7, other), (TOTAL, another), (TOTAL, first)):
        monkeypatch.setattr("bayesfred.sampling.sampler.versions", lambda here=here: here)
        made = run(posterior, None, path, total, resume=True)
        found = open_chain(path)
        for chain in (made, found):
            assert chain.versions == (here if total > 3 and here != first else chain.versions)
    assert (found.versions, found.earlier) == (another, ((3, first), (7, other)))
    assert draws_of(found) == draws_of(whole)
    numpy = f"until step 3 numpy {first['numpy']}; until step 3 wheel not there"
    assert found.version_history.endswith(
        f"wheel 1; {numpy}; until step 7 numpy 9.9; until step 7 wheel not there"
    )
    write_chain(found)
    assert open_chain(path).earlier == found.earlier
    with h5py.File(path, "a") as file:
        file["versions"].move("until_7", f"until_{TOTAL}")
    reseal(path)
    with pytest.raises(InputError, match="versions of steps that there are not"):
        open_chain(path)


def test_steps_is_a_total(
    posterior: Posterior, estimate: MapEstimate, whole: Chain, tmp_path: Path
) -> None:
    path = tmp_path / "chain.h5"
    shutil.copy(whole.path, path)
    for steps in (TOTAL, 3):
        assert draws_of(run(posterior, estimate, path, steps, resume=True)) == draws_of(whole)
    assert_same_file(path, whole.path)


def test_a_run_to_a_target_resumes_to_the_same_draws(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    options = {"target_ess": 150.0, "walkers": 16}
    whole = run(posterior, estimate, tmp_path / "a.h5", None, **options)
    assert 8 <= whole.chain.shape[1] < 60
    run(posterior, estimate, tmp_path / "b.h5", 7, **options)
    assert draws_of(
        run(posterior, estimate, tmp_path / "b.h5", None, resume=True, **options)
    ) == draws_of(whole)
    assert draws_of(
        run(posterior, estimate, tmp_path / "b.h5", None, resume=True, **options)
    ) == draws_of(whole)


@pytest.mark.parametrize(
    "nuisances",
    [
        pytest.param(Nuisances(), id="fixed"),
        pytest.param(Nuisances("free"), id="free", marks=pytest.mark.slow),
    ],
)
def test_the_seed_alone_makes_the_draws(
    posterior: Posterior, tmp_path: Path, nuisances: Nuisances
) -> None:
    if nb.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one core")
    posterior = Posterior(posterior.model, posterior.counts, nuisances=nuisances)
    estimate, before = find_map(posterior), nb.get_num_threads()
    chains = []
    try:
        for threads, seed in ((1, 1), (2, 1), (2, 2)):
            nb.set_num_threads(threads)
            chains.append(
                draws_of(run(posterior, estimate, tmp_path / f"{threads}{seed}.h5", 4, seed=seed))
            )
    finally:
        nb.set_num_threads(before)
    assert chains[0] == chains[1] != chains[2]


# --- refusals -------------------------------------------------------------------------------------


def test_an_existing_file_is_refused_or_replaced(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    path = tmp_path / "chain.h5"
    run(posterior, estimate, path, 2)
    before = path.read_bytes()
    with pytest.raises(InputError, match="exists, expected a new file"):
        run(posterior, estimate, path, 2)
    assert path.read_bytes() == before
    assert run(posterior, estimate, path, 3, overwrite=True, seed=5).seed == 5
    with pytest.raises(InputError, match="no folder"):
        run(posterior, estimate, tmp_path / "absent" / "chain.h5")


@pytest.mark.parametrize(
    ("changed", "change"),
    [
        ("counts", lambda p: {"counts": p.counts + np.eye(60, 75)}),
        ("mask", lambda p: {"mask": np.arange(75) > 2}),
        ("noise", lambda p: {"noise": PoissonNoise(1.0)}),
        ("nuisances", lambda p: {"nuisances": Nuisances(footprint=1e4)}),
        ("prior", lambda p: {"prior": {"background": stats.halfnorm(0, 5.0)}}),
        ("model", lambda p: {"model": make_model(sigma=2.6, tolerance=1e-8)}),
        (
            "model",
            lambda p: {"model": make_model(SourceCatalog.grid(3, 17.0, 4001.0), tolerance=1e-8)},
        ),
        ("model", lambda p: {"model": make_model(tolerance=1e-9)}),
        ("model", lambda p: {"model": make_model(tolerance=1e-8, conserve_flux=False)}),
    ],
)
def test_another_posterior_is_refused(
    posterior: Posterior, whole: Chain, tmp_path: Path, changed: str, change: Any
) -> None:
    path = tmp_path / "chain.h5"
    shutil.copy(whole.path, path)
    fields: dict[str, Any] = {
        "model": posterior.model,
        "counts": posterior.counts,
        **change(posterior),
    }
    if "mask" in fields:
        fields["mask"] = np.broadcast_to(fields["mask"], (60, 75))
    other = Posterior(fields.pop("model"), fields.pop("counts"), **fields)
    names = [
        name
        for name, digest in fingerprint(other).items()
        if digest != fingerprint(posterior)[name]
    ]
    assert changed in names
    with pytest.raises(InputError, match=f"made with other {', '.join(names)}, expected the same"):
        run(other, whole.estimate, path, resume=True)
    assert path.read_bytes() == whole.path.read_bytes()


def test_a_second_writer_is_refused(posterior: Posterior, whole: Chain, tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    shutil.copy(whole.path, path)
    with filelock.FileLock(tmp_path / ".chain.h5.lock"):
        for options in ({"resume": True}, {"overwrite": True}):
            with pytest.raises(InputError, match="another process is writing"):
                run(posterior, whole.estimate, path, TOTAL + 1, **options)
        assert draws_of(open_chain(path)) == draws_of(whole)  # readers do not mind
    run(posterior, whole.estimate, path, TOTAL + 1, resume=True)


@pytest.mark.parametrize(
    "options", [{"ensembles": 1}, {"walkers": 5}, {"walkers": 2}, {"target_ess": 0.0}, {"steps": 0}]
)
def test_numbers_are_checked(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path, options: dict[str, Any]
) -> None:
    with pytest.raises(InputError, match=f"sampling: {next(iter(options))}: got"):
        run(posterior, estimate, tmp_path / "chain.h5", **options)
    assert not list(tmp_path.iterdir())


def test_an_estimate_off_the_posterior_is_refused(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    far = MapEstimate(estimate.params - np.eye(13)[12] * 1e3, estimate.covariance, 0.0, 1, "")
    with pytest.raises(InputError, match="estimate: the posterior has no density"):
        run(posterior, far, tmp_path / "chain.h5")


# --- accidents, of which test_sampling_accidents.py has more --------------------------------------


CALLS_OF_A_STEP = 2  # one an ensemble, before the first look


def spoilt(bad: Mapping[int, float], first: int = 2) -> Through:
    """The first walker's log-probability is something else in the given calls.

    They are counted after `first` calls, which place the walkers.
    """
    call = -first

    def spoil(log_prob: Callable[[ArrayLike], Floats], params: ArrayLike) -> Floats:
        nonlocal call
        values = log_prob(params)
        if call in bad:
            values[0] = bad[call]
        call += 1
        return values

    return spoil


def interrupted(calls: int) -> Through:
    """A Ctrl-C after so many calls."""
    left = calls

    def through(log_prob: Callable[[ArrayLike], Floats], params: ArrayLike) -> Floats:
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        return log_prob(params)

    return through


@pytest.mark.parametrize("calls", [3, 4, 5, 11, 17])
def test_an_interrupted_run_keeps_its_complete_steps(
    posterior: Posterior, whole: Chain, tmp_path: Path, calls: int
) -> None:
    # 2 calls place the walkers, emcee evaluates none again, and before the first look a step is a
    # call an ensemble
    path = tmp_path / "chain.h5"
    with pytest.raises(KeyboardInterrupt):
        watched(posterior, whole.estimate, path, interrupted(calls))
    complete = (calls - 2) // 2
    assert path.exists() == (complete > 0)
    if complete:
        kept = open_chain(path)
        assert np.array_equal(kept.chain, whole.chain[:, :complete])
    assert not list(tmp_path.glob(".*.tmp"))
    assert draws_of(run(posterior, whole.estimate, path, resume=True)) == draws_of(whole)
    assert_same_file(path, whole.path)


# --- log-probabilities and walkers that are none --------------------------------------------------


def test_what_is_no_density_is_refused_and_counted(
    posterior: Posterior, whole: Chain, tmp_path: Path
) -> None:
    bad = {3: math.nan, 7: math.inf, 8: math.nan, 20: math.inf, 21: -math.inf}
    a, b = tmp_path / "a.h5", tmp_path / "b.h5"
    chain = watched(posterior, whole.estimate, a, spoilt(bad))
    assert chain.n_invalid == open_chain(a).n_invalid == 4 and whole.n_invalid == 0
    assert np.isfinite(chain.log_prob).all() and np.isfinite(chain.chain).all()
    assert chain.accepted.sum() < whole.accepted.sum()
    watched(posterior, whole.estimate, b, spoilt(bad), 5)
    assert open_chain(b).n_invalid == 3
    rest = spoilt(bad, first=-5 * CALLS_OF_A_STEP)
    assert draws_of(watched(posterior, whole.estimate, b, rest, resume=True)) == draws_of(chain)
    assert_same_file(a, b)


def test_walkers_start_where_there_is_density(
    posterior: Posterior, whole: Chain, tmp_path: Path
) -> None:
    spoiling = spoilt({-2: math.inf, -1: math.nan})
    chain = watched(posterior, whole.estimate, tmp_path / "chain.h5", spoiling, 1)
    assert chain.n_invalid == 2 and np.isfinite(chain.log_prob).all()


def test_an_infinite_prior_density_is_no_density(posterior: Posterior) -> None:
    undistorted = posterior.start()
    assert math.isfinite(posterior.log_prob(undistorted))
    infinite = Posterior(
        posterior.model, posterior.counts, prior={"f_ux": stats.gamma(0.5)}
    )  # at 0
    assert infinite.log_prob(undistorted) == infinite.log_prob(undistorted[None])[0] == math.inf


TINY = np.array([1.0] * 12 + [1e-20])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda e: {"params": np.where(np.arange(13) == 3, np.nan, e.params)}, 
         "no density around it"),
        (lambda e: {"params": e.params[:12]}, "got 12 parameters, expected 13"),
        (lambda e: {"covariance": -e.covariance}, "no positive definite covariance"),
        (lambda e: {"covariance": np.ones((13, 13))}, "no positive definite covariance"),
        (lambda e: {"covariance": np.nan * e.covariance}, "no positive definite covariance"),
        (lambda e: {"covariance": e.covariance[:12]}, "no positive definite covariance"),
        (lambda e: {"covariance": e.covariance * np.outer(TINY, TINY)},
         "the same background for all walkers"),
    ],
)  # fmt: skip
def test_an_estimate_that_no_run_can_start_from_is_refused(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path, change: Any, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        run(posterior, replace(estimate, **change(estimate)), tmp_path / "chain.h5", walkers=32)
    assert not (tmp_path / "chain.h5").exists()


def test_a_covariance_that_was_rounded_is_read(whole: Chain, tmp_path: Path) -> None:
    """What a user's own search gave must not make a finished run unreadable."""
    path, covariance = tmp_path / "chain.h5", whole.estimate.covariance
    rounding = np.random.default_rng(5).uniform(-1e-9, 1e-9, covariance.shape)
    rounded = covariance * (1.0 + rounding)
    assert not np.array_equal(rounded, rounded.T)
    write_chain(replace(whole, path=path, estimate=replace(whole.estimate, covariance=rounded)))
    assert np.array_equal(open_chain(path).estimate.covariance, rounded)


def spoil_last_step(whole: Chain, path: Path, name: str, values: Floats) -> None:
    """A chain file whose last step has other walkers."""
    array = getattr(whole, name).copy()
    array[:, -1] = values
    write_chain(replace(whole, path=path, **{name: array}))


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        (
            "log_prob",
            lambda a: np.full_like(a, -np.inf),
            "16 of 16 walkers without posterior density",
        ),
        (
            "log_prob",
            lambda a: np.where(np.arange(8) == 2, np.nan, a),
            "2 of 16 walkers without posterior density",
        ),
        (
            "log_prob",
            lambda a: np.where(np.arange(8) == 2, np.inf, a),
            "2 of 16 walkers without posterior density",
        ),
        (
            "chain",
            lambda a: np.broadcast_to(a[:, :1], a.shape),
            "the same f_ux, .* for all walkers",
        ),
        (
            "chain",
            lambda a: np.repeat(a[:, ::2], 2, axis=1),
            "spread in 3 directions only, expected 7",
        ),
    ],
)
def test_a_run_that_cannot_go_on_is_refused(
    posterior: Posterior, whole: Chain, tmp_path: Path, name: str, change: Any, words: str
) -> None:
    path = tmp_path / "chain.h5"
    spoil_last_step(whole, path, name, change(getattr(whole, name)[:, -1]))
    before = path.read_bytes()
    with pytest.raises(InputError, match=f"start: got .*{words}"):
        run(posterior, None, path, TOTAL + 1, resume=True)
    assert path.read_bytes() == before


def test_a_stuck_walker_ends_the_run(posterior: Posterior, whole: Chain, tmp_path: Path) -> None:
    """One walker claims a density that no proposal has; what was sampled is saved."""
    path = tmp_path / "chain.h5"
    spoil_last_step(
        whole,
        path,
        "log_prob",
        whole.log_prob[:, -1] + np.array([[1e6] + 7 * [0.0], 8 * [0.0]]),
    )
    with pytest.raises(InputError, match="1 of 16 walkers stuck, 1000 steps without a move"):
        run(posterior, None, path, 2000, resume=True)
    kept = open_chain(path)
    assert kept.chain.shape[1] == TOTAL + 1000
    assert (
        np.ptp(kept.chain[0, -1001:, 0], axis=0).max()
        == 0.0
        < np.ptp(kept.chain[:, -1001:, 1], axis=1).min()
    )


def test_an_ensemble_that_accepts_nothing_ends_the_run(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    path, placed = tmp_path / "chain.h5", 2

    def nothing(log_prob: Callable[[ArrayLike], Floats], params: ArrayLike) -> Floats:
        nonlocal placed
        placed -= 1
        return log_prob(params) if placed >= 0 else np.full(len(np.array(params)), -np.inf)

    with pytest.raises(InputError, match="16 of 16 walkers stuck, 125 steps without a move"):
        # 125 steps of 8 walkers are 1000 proposals
        watched(posterior, estimate, path, nothing, None)
    assert open_chain(path).chain.shape[1] == 125


def damaged(whole: Path, how: str) -> bytes:
    raw = bytearray(whole.read_bytes())
    if how == "text":
        return b"u,v\n1,2\n"
    if how == "flipped":
        with h5py.File(whole, "r") as file:
            raw[file["ensemble_1/chain"].id.get_chunk_info(0).byte_offset + 100] ^= 1
        return bytes(raw)
    return bytes(raw[: int(float(how) * len(raw))])


@pytest.mark.parametrize("how", ["text", "flipped", "0", "0.01", "0.5", "0.99"])
def test_damaged_files_are_refused(
    posterior: Posterior, whole: Chain, tmp_path: Path, how: str
) -> None:
    path = tmp_path / "chain.h5"
    path.write_bytes(damaged(whole.path, how))
    with pytest.raises(InputError, match=r"chain\.h5: "):
        open_chain(path)
    with pytest.raises(InputError, match=r"chain\.h5: "):
        run(posterior, whole.estimate, path, resume=True)


def test_missing_and_foreign_files_are_refused(whole: Chain, tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    for absent in (path, tmp_path):
        with pytest.raises(InputError, match="no such file"):
            open_chain(absent)
    with h5py.File(path, "w") as file:
        file["image"] = np.zeros(3)
    with pytest.raises(InputError, match="got no seal at the end"):
        open_chain(path)
    reseal(path)
    with pytest.raises(InputError, match="got None of schema None"):
        open_chain(path)
    for spoil in ("schema", "kind"):
        shutil.copy(whole.path, path)
        with h5py.File(path, "a") as file:
            file.attrs[spoil] = 99
        reseal(path)
        with pytest.raises(InputError, match="expected bayesfred chain of schema"):
            open_chain(path)


@pytest.mark.parametrize(
    "part", ["estimate", "versions", "ensemble_1", "ensemble_0/chain", "estimate/params"]
)
def test_incomplete_files_are_refused(whole: Chain, tmp_path: Path, part: str) -> None:
    path = tmp_path / "chain.h5"
    shutil.copy(whole.path, path)
    with h5py.File(path, "a") as file:
        del file[part]
    reseal(path)
    with pytest.raises(InputError, match=r"chain\.h5: "):
        open_chain(path)


# --- the posterior in the file --------------------------------------------------------------------

POSTERIORS: list[tuple[Nuisances, Any, Detector, bool]] = [
    (Nuisances(), PoissonNoise(1.25), Detector((60, 75)), True),
    (Nuisances("scale", footprint=12.5), BackgroundNoise(), Detector((60, 75)), False),
    (
        Nuisances("free", psf_sigma=True, background_order=1),
        PoissonNoise(),
        Detector((30, 37), 2, "box"),
        True,
    ),
    (EVERYTHING, PoissonNoise(), Detector((20, 25), 3), True),
]


@pytest.mark.slow
@pytest.mark.parametrize(("nuisances", "noise", "detector", "conserve_flux"), POSTERIORS)
def test_the_posterior_is_rebuilt(
    tmp_path: Path, nuisances: Nuisances, noise: Any, detector: Detector, conserve_flux: bool
) -> None:
    rng = np.random.default_rng(51)
    model = make_model(detector=detector, tolerance=1e-8, conserve_flux=conserve_flux)
    prior = {
        "f_ux": stats.t(4.0, 0.0, 1e-3),
        "background": stats.gamma(2.0, scale=3.0),
        "g_uy": stats.uniform(-1e-2, 2e-2),
    }
    mask = rng.random(detector.shape) < 0.9
    options = {"nuisances": nuisances, "noise": noise, "prior": prior, "mask": mask}
    posterior, truth = make_posterior(model, make_truth(model, rng), rng, **options)
    covariance = np.linalg.inv(posterior.information(truth))
    estimate = MapEstimate(
        truth, 0.5 * (covariance + covariance.T), posterior.log_prob(truth), 1, "the truth"
    )
    chain = run(posterior, estimate, tmp_path / "chain.h5", 2)
    again = open_chain(chain.path).posterior()
    points = chain.chain[:, -1].reshape(-1, truth.size)
    assert again.log_prob(points).tobytes() == posterior.log_prob(points).tobytes()
    assert np.isfinite(again.log_prob(points)).all() and math.isfinite(again.log_prob(truth))
    assert np.array_equal(again.gradient(truth), posterior.gradient(truth), equal_nan=True)
    assert (again.parameter_names, again.noise, again.nuisances) == (
        posterior.parameter_names,
        noise,
        nuisances,
    )
    assert fingerprint(again) == fingerprint(posterior)


def test_no_share_of_a_run_is_told_from_the_number_of_draws() -> None:
    """They are no effective draws: 88 % after 7 steps came before 12 % after 8."""
    steps = np.random.default_rng(1).standard_normal((4, 40, 32, 2)).cumsum(axis=1)
    assert sufficient(steps[:, :7], 1000.0) == (False, 0.0)
    enough, share = sufficient(steps, 1000.0)
    assert not enough and 0.0 < share < 0.9
    assert sufficient(np.diff(steps, axis=1), 1000.0)[1] > 1.0


@pytest.mark.parametrize("effective", [0.0, 1e-15, 1e-3])
def test_walkers_that_hardly_move_leave_half_the_run_out(effective: float) -> None:
    """However long the correlation is; 1/effective overflows no logarithm."""
    assert forgetting(80, effective, 2560) == 40


@pytest.mark.parametrize(("tau", "left_out"), [(1.0, 0), (1.2, 1), (3.0, 4), (9.0, 13)])
def test_the_first_step_that_is_kept_has_forgotten_the_start(tau: float, left_out: int) -> None:
    r = (tau - 1.0) / (tau + 1.0)
    assert forgetting(80, 2560 / tau, 2560) == left_out
    assert r ** (left_out + 1) <= 0.05 < max(r, 1e-9) ** left_out


def test_differential_evolution_begins_after_the_first_look(
    posterior: Posterior, whole: Chain
) -> None:
    shares = [
        {
            type(move): share
            for move, share in moves_after(posterior, whole.estimate, whole.chain[:, :n])
        }[emcee.moves.DEMove]
        for n in (0, 1, 7, 8, 12)
    ]
    assert adapted(whole.chain) == 0 and shares == [0.0, 0.0, 0.0, DE_SHARE, DE_SHARE]


def test_a_resumed_run_is_checked_after_the_same_steps(
    posterior: Posterior, estimate: MapEstimate
) -> None:
    """Wherever it stopped, a check's own step included."""
    due = list(islice(checks(), 8))
    assert due == [8, 9, 10, 11, 12, 13, 14, 15]

    def until(run: Run, steps: int | None) -> Chain:
        with threadpool_limits(1, user_api="blas"):
            return run.until(100.0, steps, in_memory(), show=False)

    def fresh() -> Run:
        return Run(posterior, estimate, 1, ensembles=2, walkers=8)

    enough = until(fresh(), None)
    last = enough.chain.shape[1]
    assert last > 9
    for stop in (1, 8, last - 1, last):
        resumed = Run.resumed(posterior, until(fresh(), stop))
        assert draws_of(until(resumed, None)) == draws_of(enough)

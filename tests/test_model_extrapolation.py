"""Free fluxes and shifts extrapolated from other parameters: the likelihood is the one that is
searched for from nothing."""

import copy
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_model import known, make_model, make_truth

from bayesfred.analysis.verify import verify
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import MoffatPSF
from bayesfred.model.extrapolation import Extrapolation, FluxExtrapolation, ShiftExtrapolation
from bayesfred.model.kernels.extrapolate import ENOUGH
from bayesfred.model.likelihood import FrameLikelihood
from bayesfred.model.noise import PoissonNoise
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.sampler import sample

Floats = NDArray[np.float64]

AGREE = 2e-6  # of log-probabilities
SCATTERED_AGREE = 1e-4  # where positions scatter
APART = SourceCatalog.grid(3, 17.0, 4e3)
TOUCHING = SourceCatalog.grid(3, 9.0, 2e4)
CASES: dict[str, tuple[ForwardModel, Nuisances, PoissonNoise]] = {
    "apart": (make_model(APART, tolerance=1e-8), Nuisances("free"), PoissonNoise()),
    "touching": (make_model(TOUCHING, tolerance=1e-8), Nuisances("free"), PoissonNoise()),
    "faint": (
        make_model(SourceCatalog.grid(3, 9.0, 200.0), tolerance=1e-8),
        Nuisances("free"),
        PoissonNoise(),
    ),
    "nuisances": (
        make_model(TOUCHING, tolerance=1e-8),
        Nuisances("free", offset=True, background_order=4),
        PoissonNoise(1.5),
    ),
    "box": (
        make_model(APART, detector=Detector((20, 25), 3, "box"), tolerance=1e-6),
        Nuisances("free"),
        PoissonNoise(),
    ),
    "scattered": (
        make_model(TOUCHING, tolerance=1e-8),
        Nuisances("free", offset=True, position_scatter=True),
        PoissonNoise(),
    ),
    "scattered, model error": (
        make_model(APART, tolerance=1e-8),
        Nuisances("free", position_scatter=True, model_error=True),
        PoissonNoise(1.5),
    ),
    "Moffat": (
        replace(make_model(TOUCHING), psf=MoffatPSF(5.0, 3.0), tolerance=1e-4),
        Nuisances("free"),
        PoissonNoise(),
    ),
}


def solved(case: str) -> tuple[Posterior, Posterior, MapEstimate]:
    """A posterior, the same near its maximum, and the maximum."""
    model, nuisances, noise = CASES[case]
    rng = np.random.default_rng(60)
    options: Any = {
        "noise": noise,
        "nuisances": nuisances,
        "mask": rng.random(model.detector.shape) < 0.95,
    }
    named = {"position_scatter": 0.2, "model_error": 0.02} | known(
        make_truth(model, rng), nuisances
    )
    blank = Posterior(model, np.ones(model.detector.shape), **options)
    truth = np.array([named[name] for name in blank.parameter_names])
    frame = blank.simulate(truth, rng)
    assert frame is not None
    posterior = Posterior(model, frame, **options)
    best = find_map(posterior, truth)
    return posterior, posterior.near(best.params, best.covariance), best


def draws(best: MapEstimate, sd: float) -> Floats:
    """Draws of the Laplace approximation, so many times as wide."""
    whitened = np.random.default_rng(61).standard_normal((12, best.params.size))
    return np.asarray(best.params + sd * whitened @ np.linalg.cholesky(best.covariance).T)


# what costs most to compile is among the long runs
LONG = {"nuisances", "Moffat", "scattered, model error"}
COSTLY = dict.fromkeys(LONG, pytest.mark.long) | {"scattered": pytest.mark.slow}
SCATTERED = pytest.param("scattered", marks=pytest.mark.slow)
NAMES = [pytest.param(name, marks=COSTLY.get(name, ())) for name in CASES]


@pytest.mark.parametrize("case", NAMES)
def test_near_the_maximum_log_prob_is_the_same(case: str) -> None:
    posterior, near, best = solved(case)
    agree = SCATTERED_AGREE if "scattered" in case else AGREE
    for sd in (0.1, 1.0, 3.0):
        searched, extrapolated = posterior.log_prob(draws(best, sd)), near.log_prob(draws(best, sd))
        assert extrapolated == pytest.approx(searched, rel=0, abs=agree)
        if sd == 1.0:  # other digits: most are not the searched ones once more
            assert np.mean(extrapolated != searched) > 0.5


@pytest.mark.parametrize("case", ["touching", "faint", SCATTERED])
def test_far_from_it_log_prob_is_the_same(case: str) -> None:
    posterior, near, best = solved(case)
    for sd in (10.0, 100.0, 1000.0):
        searched, extrapolated = posterior.log_prob(draws(best, sd)), near.log_prob(draws(best, sd))
        assert np.array_equal(np.isfinite(extrapolated), np.isfinite(searched))
        assert extrapolated == pytest.approx(searched, rel=1e-12, abs=ENOUGH)


@pytest.mark.parametrize("case", ["touching", "faint", SCATTERED])
def test_a_vector_by_itself_has_the_log_prob_that_it_has_among_others(case: str) -> None:
    """Also where nothing is left to search for, and where all is."""
    _, near, best = solved(case)
    for sd in (1.0, 100.0):
        vectors = draws(best, sd)
        alone = [float(near.log_prob(each)) for each in vectors]
        assert alone == near.log_prob(vectors).tolist()


def test_a_vector_has_the_same_bits_whatever_others_there_are() -> None:
    """A frame's vectors are shared out among any number of workers."""
    random = np.random.default_rng(3)
    apart = 0
    for sources, d in ((64, 22), (400, 70), (9, 5)):
        nothing: Any = None
        beliefs = FluxExtrapolation(
            nothing, np.zeros(d), np.ones(sources), random.standard_normal((sources, d)), nothing,
            (nothing,) * 6,
        )  # fmt: skip
        vectors = random.standard_normal((33, d))
        every = beliefs.at(vectors)
        for n in range(1, 33):
            some = beliefs.at(vectors[:n])
            assert some.fluxes.tobytes() == every.fluxes[:n].tobytes()
            # negative control: a matrix product
            product = (vectors @ beliefs.slope.T)[:n].tobytes()
            apart += (vectors[:n] @ beliefs.slope.T).tobytes() != product
    assert apart


def changed(near: Posterior, **parts: Any) -> Posterior:
    """The same with other beliefs about the fluxes."""
    assert isinstance(near.extrapolation, FluxExtrapolation)
    return replace(near, extrapolation=near.extrapolation._replace(**parts))


def test_wrong_beliefs_cost_time_alone_unless_they_are_about_the_hessian() -> None:
    posterior, near, best = solved("touching")
    beliefs = near.extrapolation
    assert beliefs is not None
    params = draws(best, 1.0)
    searched = posterior.log_prob(params)
    for flux in (1.02, 3.0, -1.0):
        assert changed(near, fluxes=flux * beliefs.fluxes).log_prob(params) == pytest.approx(
            searched, rel=0, abs=AGREE
        )
    assert changed(near, slope=0.0 * beliefs.slope).log_prob(params) == pytest.approx(
        searched, rel=0, abs=AGREE
    )
    # negative control: without the products of neighbours' templates it is not
    diagonal, first, _, *rest = beliefs.hessian
    alone = changed(near, hessian=(diagonal, first, first, *rest))
    assert np.abs(alone.log_prob(params) - searched).min() > 10 * AGREE


@pytest.mark.slow
def test_wrong_beliefs_about_shifts_cost_time_alone_unless_they_are_about_the_rest_of_the_way() -> (
    None
):
    posterior, near, best = solved("scattered")
    beliefs = near.extrapolation
    assert isinstance(beliefs, ShiftExtrapolation)
    params, known = draws(best, 1.0), beliefs.nearby
    searched = posterior.log_prob(params)

    def errors(**parts: Any) -> Floats:
        wrong = replace(near, extrapolation=beliefs._replace(**parts))
        return np.abs(wrong.log_prob(params) - searched)

    for parts in (
        {"found": beliefs.found * [1.02, 0.5, 0.5]},
        {"slope": 0.0 * beliefs.slope},
        {"nearby": known._replace(bends=0.0 * known.bends)},
        {"nearby": known._replace(bends=-1e9 + 0.0 * known.bends)},  # no step can be taken by them
    ):
        assert errors(**parts).max() < SCATTERED_AGREE
    # fluxes grow twofold in a step: the search does not end, and is made again from nothing
    assert errors(found=beliefs.found * [1e-6, 1.0, 1.0]).max() == 0.0
    # negative control: without the change of the determinant it is not
    unbent = known._replace(e=0.0 * known.e, spread=0.0 * known.spread)
    assert errors(nearby=unbent).max() > 10.0 * errors().max()


def test_without_free_fluxes_there_is_nothing_to_extrapolate() -> None:
    model = make_model(APART)
    for nuisances in (Nuisances(), Nuisances("scale")):
        posterior = Posterior(model, model.expected_counts(np.zeros(12), 3.0), nuisances=nuisances)
        assert posterior.near(posterior.start(), np.eye(posterior.n_parameters)) is posterior


@pytest.mark.parametrize(
    ("case", "agree"),
    [
        ("touching", AGREE),
        pytest.param("scattered", SCATTERED_AGREE, marks=pytest.mark.slow),
    ],
)
def test_a_chain_of_free_fluxes_holds_the_log_prob_of_its_draws(
    case: str, agree: float, tmp_path: Path
) -> None:
    posterior, _, best = solved(case)

    def run(name: str, steps: int, **options: Any) -> Any:
        return sample(
            posterior,
            best,
            path=tmp_path / name,
            seed=3,
            walkers=8,
            steps=steps,
            progress=False,
            **options,
        )

    whole = run("whole.h5", 6)
    assert posterior.log_prob(whole.chain.reshape(-1, best.params.size)) == pytest.approx(
        whole.log_prob.ravel(), rel=0, abs=agree
    )
    run("parts.h5", 3)
    parts = run("parts.h5", 6, resume=True)
    assert np.array_equal(parts.chain, whole.chain) and np.array_equal(
        parts.log_prob, whole.log_prob
    )
    assert all(check.holds for check in verify(tmp_path / "whole.h5"))


def test_a_chain_that_went_far_verifies(tmp_path: Path) -> None:
    posterior, _, best = solved("faint")
    wide = replace(best, covariance=25.0 * best.covariance)
    path = tmp_path / "wide.h5"
    sample(posterior, wide, path=path, seed=4, walkers=8, steps=6, progress=False)
    assert {check.what: check.holds for check in verify(path)}["log-probability"]


@pytest.mark.parametrize("case", ["touching", SCATTERED])
def test_copies_keep_the_extrapolation(case: str) -> None:
    """Pickled, copied or with another prior: the same object state, so the same fast answers."""
    _, near, best = solved(case)
    prior = {"background": near.prior["background"]}
    for again in (pickle.loads(pickle.dumps(near)), copy.copy(near), replace(near, prior=prior)):
        assert isinstance(again.extrapolation, Extrapolation)
        assert (
            again.log_prob(draws(best, 1.0)).tobytes() == near.log_prob(draws(best, 1.0)).tobytes()
        )


def test_an_extrapolation_is_of_one_model() -> None:
    _, near, _ = solved("touching")
    with pytest.raises(InputError, match="extrapolation: got that of another model, expected"):
        replace(near, model=replace(near.model, tolerance=1e-9))


def test_where_there_is_no_density_the_other_side_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without that of the first parameter, or with neither side, for which nothing changes."""
    posterior, near, best = solved("touching")
    search, reach = FrameLikelihood._found, 0.0

    def found(likelihood: FrameLikelihood, vectors: Floats) -> Floats:
        out = search(likelihood, vectors)
        out[vectors[:, 0] - best.params[0] > reach] = np.nan
        return out

    def slope(posterior: Posterior) -> Floats:
        known = posterior.likelihood.extrapolation
        assert isinstance(known, FluxExtrapolation)
        return known.slope / np.abs(known.slope).max(axis=0)

    monkeypatch.setattr(FrameLikelihood, "_found", found)
    other = slope(posterior.near(best.params, best.covariance))
    assert other == pytest.approx(slope(near), abs=0.1)
    assert not np.array_equal(other[:, 0], slope(near)[:, 0])
    reach = -10.0
    none = posterior.near(best.params, best.covariance).likelihood.extrapolation
    assert isinstance(none, FluxExtrapolation) and not none.slope.any()

"""Leaving out sources against exact integrals, and on models that are known to be wrong.

Chains are draws of the Laplace approximation unless sampling matters, so that each test costs
seconds.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.special import logsumexp
from test_sampling_protocol import CutGaussian, top
from typer.testing import CliRunner

import bayesfred as bf
from bayesfred.analysis import comparison as module
from bayesfred.analysis.comparison import Comparison, Score, compare
from bayesfred.analysis.extra_parameters import ExtraParameters, judge_extra
from bayesfred.analysis.folds import fold_sources
from bayesfred.cli import app

Floats = NDArray[np.float64]
TERM, OTHER = (1, 0, 0, 0), (0, 1, 0, 0)
LEVEL = 1.0
PLACES = [-12.0, 12.0, 0.0], [-8.0, -10.0, 12.0]


def forward(*f_terms: tuple[int, ...], flux: float = 2000.0) -> bf.ForwardModel:
    """Three sources so far apart that none reaches another's pixels."""
    return bf.ForwardModel(
        bf.Detector((43, 43)), bf.SourceCatalog(*PLACES, [flux] * 3), bf.GaussianPSF(1.5),
        bf.PolynomialDistortion(f_terms, []),
    )  # fmt: skip


def frame(*, flux: float = 2000.0, scatter: float = 0.0, seed: int = 3) -> Floats:
    model = forward(TERM, flux=flux)
    off = scatter * np.random.default_rng([4, seed]).normal(size=(2, 3))
    sources = bf.SourceCatalog(*(np.array(PLACES) + off), model.sources.flux)
    return bf.simulate(replace(model, sources=sources), [0.02], LEVEL, seed=seed)


def laplace(posterior: bf.Posterior) -> bf.Chain:
    return bf.laplace(posterior, seed=1, progress=False)


# --- predicted sources ----------------------------------------------------------------------------


def exact(
    posterior: bf.Posterior, theta: Floats, flux: Floats, shift: Floats, tau: Floats
) -> Floats:
    """log p(F | R) of every source and the pixels nearest to it, for a background that is known.

    Sources do not touch, so that given theta each has its own integral over flux and shifts. Counts
    are relative to those of the background alone. The grids are as fine as their sums converge.
    """
    model, counts = posterior.model, posterior.counts
    width, cut = model.psf.sigma, 6.0 * model.psf.sigma
    names = posterior.parameter_names
    u, v = model.detector.pixel_centres()
    scale = model.sources.flux[0] / 2.0
    weigh_flux = (
        stats.gamma(2.0, scale=scale).logpdf(flux) + np.log(flux[1] - flux[0])
        if flux.size > 1 else np.zeros(1)
    )  # fmt: skip
    step = shift[1] - shift[0] if shift.size > 1 else 1.0
    by_source = np.zeros((3, theta.size, tau.size))
    for s, (x, y) in enumerate(zip(*PLACES, strict=True)):
        for i, t in enumerate(theta):
            # a shift is as imaged, and the distortion that of the catalogue's position
            centre = x - t * x
            du = u[None, :] - centre - shift[:, None]
            dv = v[None, :] - y - shift[:, None]
            along, across = (np.exp(-0.5 * (d / width) ** 2) for d in (du, dv))
            near = (np.abs(u - centre) < cut)[None, :] & (np.abs(v - y) < cut)[:, None]
            rows, columns = np.nonzero(near)
            unit = across[:, None, rows] * along[None, :, columns] / (2.0 * np.pi * width**2)
            n = counts[rows, columns]
            ratio = flux[:, None, None, None] * unit / LEVEL
            each = np.log1p(ratio) @ n - LEVEL * ratio.sum(axis=-1)  # flux, along v, along u
            each = logsumexp(each + weigh_flux[:, None, None], axis=0)
            for j, size in enumerate(tau):
                # Student's t in two dimensions, of 3 degrees of freedom
                rho = (shift[:, None] ** 2 + shift**2) / (3.0 * size**2)
                weigh = -2.5 * np.log1p(rho) + np.log(step**2 / (2.0 * np.pi * size**2))
                weigh = weigh if shift.size > 1 else np.zeros((1, 1))
                by_source[s, i, j] = logsumexp(each + weigh)
    prior = posterior.prior["f_x"].logpdf(theta)[:, None]
    if "position_scatter" in names:
        prior = prior + posterior.prior["position_scatter"].logpdf(tau)
    whole = logsumexp(prior + by_source.sum(axis=0))
    folds = fold_sources(posterior, bf.find_map(posterior).params, module.FOLDS)
    empty = stats.poisson(LEVEL).logpmf(counts)
    return np.array(
        [
            empty[folds.pixels == folds.sources[s]].sum() + whole
            - logsumexp(prior + by_source.sum(axis=0) - by_source[s])
            for s in range(3)
        ]
    )  # fmt: skip


def predicted(posterior: bf.Posterior, chain: bf.Chain) -> Floats:
    """by_fold in the order of the sources."""
    found = compare({"a": chain, "b": chain})
    assert sorted(found.folds) == [(0,), (1,), (2,)]
    order = np.argsort([sources[0] for sources in found.folds])
    return found.scores[0].by_fold[order]


KNOWN = {"background": stats.norm(LEVEL, 1e-4)}
AT_REST = np.zeros(1), np.ones(1)  # no shift; the scatter does not matter


def test_fixed_fluxes_are_predicted_as_exact_refits_do() -> None:
    posterior = bf.Posterior(forward(TERM), frame(), prior=KNOWN)
    theta = np.linspace(-0.01, 0.05, 241)
    direct = exact(posterior, theta, np.array([2000.0]), *AT_REST)
    found = predicted(posterior, laplace(posterior))
    assert found == pytest.approx(direct, abs=0.05)
    # the negative control: refits that know the fold's pixels
    seen = posterior.likelihood.log_likelihood(
        bf.find_map(posterior).params[None], np.ones(1, bool)
    )
    assert direct.sum() < seen[0] - 0.5


def test_free_fluxes_are_predicted_as_exact_refits_do() -> None:
    posterior = bf.Posterior(
        forward(TERM, flux=400.0), frame(flux=400.0), prior=KNOWN, nuisances=bf.Nuisances("free")
    )
    direct = exact(
        posterior, np.linspace(-0.02, 0.06, 81), np.linspace(250.0, 600.0, 141), *AT_REST
    )
    found = predicted(posterior, laplace(posterior))
    assert found == pytest.approx(direct, abs=0.05)
    fixed = replace(posterior, nuisances=bf.Nuisances())
    compared = compare({"free": laplace(posterior), "fixed": laplace(fixed)})
    assert compared.chosen == "fixed" and compared.scores[1].difference > 3.0
    assert [score.n_parameters for score in compared.scores] == [2, 5]


def test_scattered_positions_are_predicted_as_exact_refits_do() -> None:
    posterior = bf.Posterior(
        forward(TERM, flux=400.0), frame(flux=400.0, scatter=0.3), prior=KNOWN,
        nuisances=bf.Nuisances("free", position_scatter=True),
    )  # fmt: skip
    direct = exact(
        posterior, np.linspace(-0.1, 0.14, 17), np.linspace(290.0, 530.0, 9),
        np.linspace(-1.2, 1.2, 33), np.linspace(0.02, 1.5, 40),
    )  # fmt: skip
    chain = bf.sample(posterior, seed=1, target_ess=400, progress=False)
    assert predicted(posterior, chain) == pytest.approx(direct, abs=0.15)


# --- what is preferred ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def right() -> bf.Chain:
    return laplace(bf.Posterior(forward(TERM), frame()))


def test_missing_term_is_missed_and_needless_one_is_not_chosen(right: bf.Chain) -> None:
    counts = right.posterior().counts
    without, more = (
        laplace(bf.Posterior(forward(*terms), counts)) for terms in ((OTHER,), (TERM, OTHER))
    )
    compared = compare({"without": without, "more": more, "right": right})
    scores = {s.name: s for s in compared.scores}
    assert compared.chosen == "right" and compared.reliable
    assert scores["without"].difference > 10.0
    assert scores["without"].weight < 0.01
    assert abs(scores["more"].elpd - scores["right"].elpd) < 4.0
    assert [s.n_parameters for s in (scores["more"], scores["right"])] == [3, 2]
    assert compared.scores[0].difference == compared.scores[0].difference_se == 0.0
    assert set(compared.extra) == {("right", "more"), ("without", "more")}
    assert not compared.extra["right", "more"].real
    assert scores["right"].log_evidence > scores["without"].log_evidence + 10.0


def test_difference_is_less_uncertain_than_its_parts(right: bf.Chain) -> None:
    """Folds that both models predict alike cancel."""
    more = laplace(bf.Posterior(forward(TERM, OTHER), right.posterior().counts))
    last = compare({"more": more, "right": right}).scores[1]
    assert last.difference_se < 0.2 * np.hypot(last.elpd_se, last.elpd_se)


LINEAR = bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
SIX = [(2, 0, 0, 0), (1, 1, 0, 0), (0, 2, 0, 0), (3, 0, 0, 0), (1, 2, 0, 0), (0, 3, 0, 0)]
USELESS = bf.PolynomialDistortion([*LINEAR.f_terms, *SIX], [*LINEAR.g_terms, *SIX])
QUADRATIC = bf.PolynomialDistortion([*LINEAR.f_terms, SIX[0]], LINEAR.g_terms)
STARS = bf.SourceCatalog.grid(5, 15.0, 1e4)


def field(
    distortion: bf.PolynomialDistortion, sources: bf.SourceCatalog = STARS
) -> bf.ForwardModel:
    return bf.ForwardModel(bf.Detector((81, 81)), sources, bf.GaussianPSF(2.0), distortion)


def scattered(seed: int, scatter: float, truth: Sequence[float] = (2e-3, 2e-3)) -> Floats:
    """A frame whose sources lie off their catalogue positions."""
    off = scatter * np.random.default_rng([5, seed]).normal(size=(2, 25))
    sources = bf.SourceCatalog(STARS.x + off[0], STARS.y + off[1], STARS.flux)
    distortion = LINEAR if len(truth) == 2 else QUADRATIC
    return bf.simulate(field(distortion, sources), truth, 3.0, seed=seed)


def both(counts: Floats, larger: bf.PolynomialDistortion) -> dict[str, bf.Chain]:
    models = {"leaner": LINEAR, "larger": larger}
    return {name: laplace(bf.Posterior(field(d), counts)) for name, d in models.items()}


def gain(compared: Comparison) -> tuple[float, float]:
    """Of the larger model in elpd, and its standard error."""
    scores = {score.name: score for score in compared.scores}
    values = scores["larger"].by_fold - scores["leaner"].by_fold
    return float(values.sum()), float(np.sqrt(values.size * values.var(ddof=1)))


def pixel_gain(chains: dict[str, bf.Chain]) -> tuple[float, float]:
    """The same, leaving out one pixel at a time: harmonic means over the draws."""
    elpd = {}
    for name, chain in chains.items():
        posterior = chain.posterior()
        mu = np.array([posterior.expected_counts(draw) for draw in chain.draws()[::5]])
        values = stats.poisson.logpmf(posterior.counts, mu)
        elpd[name] = np.log(len(mu)) - logsumexp(-values, axis=0)
    values = elpd["larger"] - elpd["leaner"]
    return float(values.sum()), float(np.sqrt(values.size * values.var()))


def test_useless_terms_fit_the_scatter_of_the_catalogue_and_are_not_chosen() -> None:
    """The negative control, which leaves out pixels, prefers them beyond doubt."""
    chains = both(scattered(0, 0.15), USELESS)
    compared = compare(chains)
    value, error = gain(compared)
    assert compared.chosen == "leaner" and value < 2.0 * error
    found = compared.extra["leaner", "larger"]
    assert len(found.names) == 12 and found.chi2 > 100.0
    assert not found.real and found.widening > 4.0
    value, error = pixel_gain(chains)
    assert value > max(4.0, 2.0 * error)


@pytest.mark.statistics
@pytest.mark.parametrize("scatter", [0.0, 0.15])
def test_useless_terms_are_hardly_ever_chosen(scatter: float) -> None:
    """In 50 frames, of which 2.5 are 5 %: up to 6 have a probability of 0.99.

    Measured were 0 with a scatter of 0.15 pixels, and 0 chosen.
    """
    compared = [compare(both(scattered(seed, scatter), USELESS)) for seed in range(50)]
    gains = np.array([gain(each) for each in compared])
    assert np.sum(gains[:, 0] > 2.0 * gains[:, 1]) <= 6
    assert sum(each.chosen == "larger" for each in compared) <= 3
    assert sum(each.extra["leaner", "larger"].real for each in compared) <= 3


@pytest.mark.statistics
def test_leaving_out_pixels_prefers_useless_terms() -> None:
    """The negative control of the test above."""
    gains = np.array([pixel_gain(both(scattered(seed, 0.15), USELESS)) for seed in range(10)])
    assert np.sum(gains[:, 0] > np.maximum(4.0, 2.0 * gains[:, 1])) >= 9


@pytest.mark.statistics
def test_a_small_term_is_called_real_though_it_hardly_predicts() -> None:
    """Of 3.5 sd, in 50 frames: measured are 8 in which it is chosen and 39 in which it is real.

    The shares have errors of 0.06. Without it the probability is 0.01, and that of more than 3
    frames in 50 is 0.002.
    """
    estimate = bf.find_map(bf.Posterior(field(QUADRATIC), scattered(0, 0.0)))
    small = 3.5 * float(np.sqrt(estimate.covariance[1, 1]))
    for size, fewest, most in ((small, 26, 50), (0.0, 0, 3)):
        found = [
            compare(both(scattered(seed, 0.0, (2e-3, size, 2e-3)), QUADRATIC)) for seed in range(50)
        ]
        real = [each.extra["leaner", "larger"].real for each in found]
        assert fewest <= sum(real) <= most
        chosen = sum(each.chosen == "larger" for each in found)
        assert chosen <= sum(real)
        if size:
            assert chosen <= 25
            assert all(
                "real, but uncertain to predict better" in " ".join(each.sentences)
                for each, is_real in zip(found, real, strict=True)
                if is_real and each.chosen == "leaner"
            )


# --- extra parameters -----------------------------------------------------------------------------


def regression(scatter: float, seed: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Least squares with errors of 1: the last two of six coefficients, which are zero, their
    covariance, the influences of 20 points and the changes when they are left out."""
    rng = np.random.default_rng([8, seed])
    design = np.vander(np.linspace(-1.0, 1.0, 20), 6)
    data = scatter * rng.normal(size=20)
    covariance = np.linalg.inv(design.T @ design)
    influence = design * (data - design @ covariance @ design.T @ data)[:, None] @ covariance
    leverage = np.einsum("ki,ij,kj->k", design, covariance, design)
    change = influence / (1.0 - leverage)[:, None]
    return (
        (covariance @ design.T @ data)[:2], covariance[:2, :2], influence[:, :2], change[:, :2],
    )  # fmt: skip


def test_errors_by_sources_are_those_of_the_scatter() -> None:
    """The changes alone would be too large, the influences alone too small.

    The mean of 400 squared ratios has an error of 0.02, relative.
    """
    names = ("a", "b")
    found = [regression(3.0, seed) for seed in range(400)]
    squares = [judge_extra(names, *each).widening ** 2 for each in found]
    assert np.mean(squares) == pytest.approx(9.0, rel=0.08)
    for only, side in ((3, 1.0), (2, -1.0)):
        wrong = [judge_extra(names, *each[:2], each[only], each[only]) for each in found]
        assert side * (np.mean([w.widening**2 for w in wrong]) / 9.0 - 1.0) > 0.15
    p = np.array([judge_extra(names, *each).p for each in found])
    # the error of a share of 0.05 is 0.011
    assert np.mean(p < 0.05) < 0.1 and 0.4 < np.mean(p < 0.5) < 0.6
    # by the errors of the fit alone, every second frame would have real ones
    assert (
        np.mean([stats.chi2.sf(judge_extra(names, *each).chi2, 2) < 0.01 for each in found]) > 0.4
    )


def score(name: str, by_fold: Floats, n_parameters: int) -> Score:
    return Score(name, n_parameters, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.1, 0, by_fold)


@pytest.mark.parametrize(
    ("chosen", "p", "said"),
    [
        ("a", 0.002, "b beside a: what it adds is real, but uncertain to predict better (f_x 3.4"),
        ("b", 0.002, "b beside a: what it adds is real (f_x 3.4 sd from the leaner model's value"),
        ("a", 0.3, "b beside a: what it adds is not seen (f_x 3.4 sd"),
    ],
)
def test_sentences(chosen: str, p: float, said: str) -> None:
    scores = (score("b", np.array([3.0, -1.0, 5.0]), 3), score("a", np.zeros(3), 2))
    extra = {("a", "b"): ExtraParameters(("f_x",), 11.7, 1.2, p)}
    first, second, third = Comparison(scores, chosen, ((4,), (0, 2), (1, 3)), extra).sentences
    assert first.startswith(f"chosen: {chosen}")
    assert second.startswith(said) and second.endswith("gain in prediction 7.0 +- 5.3")
    assert third.endswith("between the first two: 1, 3 (+5.0); 4 (+3.0); 0, 2 (-1.0)")


def test_a_wider_model_contains_a_leaner_one(right: bf.Chain) -> None:
    posterior, params = right.posterior(), right.estimate.params
    wider = replace(posterior, nuisances=bf.Nuisances("scale", offset=True, psf_sigma=True))
    values = module.contained(posterior, params, wider)
    assert values is not None
    assert dict(zip(wider.parameter_names, values, strict=True)) == {
        "f_x": params[0], "background": params[1], "flux_scale": 1.0, "offset_x": 0.0,
        "offset_y": 0.0, "psf_sigma": 1.5,
    }  # fmt: skip
    assert module.contained(wider, values, posterior) is None
    other = replace(wider, model=replace(wider.model, psf=bf.GaussianPSF(1.8)))
    assert module.contained(posterior, params, other) is None
    free = replace(posterior, nuisances=bf.Nuisances("free"))
    assert module.contained(posterior, params, free) is None
    loose = replace(free, nuisances=bf.Nuisances("free", position_scatter=True))
    assert module.contained(free, params, loose) is None


# --- stacking -------------------------------------------------------------------------------------


def test_stacking_weights_are_the_best() -> None:
    rng = np.random.default_rng(9)
    log_density = rng.normal(-1000.0, 2.0, (12, 3))
    found = module._stacking(log_density)
    assert found.sum() == pytest.approx(1.0) and found.min() >= 0.0

    def total(weights: Floats) -> Any:
        return logsumexp(log_density, b=weights, axis=-1).sum()

    side = np.linspace(0.0, 1.0, 101)
    others = [np.array([a, b, 1.0 - a - b]) for a in side for b in side if a + b <= 1.0]
    assert max(total(weights) for weights in others) <= total(found) + 1e-4


def test_stacking_takes_the_only_good_model_and_shares_between_equals() -> None:
    log_density = np.array([[0.0, -50.0, 0.0]] * 5)
    assert module._stacking(log_density) == pytest.approx([0.5, 0.0, 0.5], abs=1e-6)


# --- refusals and the command ---------------------------------------------------------------------


def test_what_cannot_be_compared_is_refused(right: bf.Chain) -> None:
    with pytest.raises(bf.InputError, match="at least two"):
        compare({"a": right})
    posterior = right.posterior()
    mask = np.ones((43, 43), bool)
    mask[0, 0] = False
    for other, said in (
        (replace(posterior, counts=posterior.counts + 1.0), "other: counts"),
        (replace(posterior, mask=mask), "other: mask"),
        (
            replace(posterior, noise=bf.GaussianNoise(2.0)),
            "other: noise: got a density, and probabilities of integer counts for right",
        ),
    ):
        for chains in ({"right": right, "other": replace(right, density=other)},):
            with pytest.raises(bf.InputError, match=said):
                compare(chains)
    density = CutGaussian()
    with pytest.raises(bf.InputError, match="b: "):
        compare({"a": right, "b": bf.laplace(density, top(density), seed=1, progress=False)})


def test_badly_sampled_chains_are_refused(right: bf.Chain) -> None:
    posterior = right.posterior()
    short = bf.sample(posterior, seed=1, steps=6, walkers=8, progress=False)
    with pytest.raises(bf.InputError, match=r"short: got draws .* Not sampled well: .*size"):
        compare({"right": right, "short": short})
    wide = replace(right, log_prob=right.log_prob + np.linspace(-40.0, 40.0, 1000)[:, None])
    with pytest.raises(bf.InputError, match=r"wide: got draws .*importance efficiency"):
        compare({"right": right, "wide": wide})


def test_too_few_sources_are_refused() -> None:
    model = forward(TERM)
    two = replace(model, sources=bf.SourceCatalog(PLACES[0][:2], PLACES[1][:2], [2000.0] * 2))
    chain = laplace(bf.Posterior(two, bf.simulate(two, [0.02], LEVEL, seed=1)))
    with pytest.raises(bf.InputError, match="got 2 sources with an image in the frame"):
        compare({"a": chain, "b": chain})


def test_few_draws_that_decide_are_said_not_to_be_reliable(right: bf.Chain) -> None:
    scores = compare({"a": right, "b": right}).scores
    assert max(s.pareto_k for s in scores) < module.SHAPE
    bad = replace(scores[0], n_unreliable=1)
    assert not Comparison((bad, scores[1]), "a", ((0,), (1,), (2,)), {}).reliable


def test_command_ranks_chain_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    counts = frame()
    for name, terms in (("right", [TERM]), ("wrong", [OTHER])):
        posterior = bf.Posterior(forward(*terms), counts)
        bf.sample(posterior, path=f"{name}.h5", seed=1, target_ess=200, progress=False)
    result = CliRunner().invoke(app, ["compare", "wrong.h5", "right.h5"])
    assert result.exit_code == 0
    assert result.output.index("right.h5") < result.output.index("wrong.h5")
    assert "chosen: right.h5" in result.output
    assert "log evidence" in result.output and "weight" in result.output
    for arguments, said in (
        (["right.h5"], "at least two"),
        (["right.h5", "right.h5"], "twice"),
        (["right.h5", "no.h5"], "no.h5"),
    ):
        refused = CliRunner().invoke(app, ["compare", *arguments])
        assert refused.exit_code == 2
        assert said in refused.output and "Traceback" not in refused.output

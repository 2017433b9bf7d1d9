"""Leave-one-out against brute force, and on models that are known to be wrong.

One source of 2,000 photons in 25 x 25 pixels; the chains are draws, not runs, so that each test
costs a second or two.
"""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.special import logsumexp
from typer.testing import CliRunner

import bayesfred as bf
from bayesfred.analysis.comparison import SPREAD, compare
from bayesfred.cli import app

Floats = NDArray[np.float64]
TERM, OTHER = (1, 0, 1, 0), (1, 0, 0, 1)
TRUTH = (4e-3, 1.0)


def forward(*f_terms: tuple[int, ...], flux: float = 2000.0) -> bf.ForwardModel:
    sources = bf.SourceCatalog([-6.0, 6.0, 6.0], [0.0, -5.0, 6.0], [flux] * 3)
    return bf.ForwardModel(
        bf.Detector((25, 25)), sources, bf.GaussianPSF(2.0), bf.PolynomialDistortion(f_terms, [])
    )


def posterior(
    *f_terms: tuple[int, ...], counts: Floats | None = None, **options: Any
) -> bf.Posterior:
    frame = bf.simulate(forward(TERM), TRUTH[:1], TRUTH[1], seed=3) if counts is None else counts
    return bf.Posterior(forward(*f_terms), frame, **options)


def drawn(target: bf.Posterior, n: int = 2000, seed: int = 1) -> Any:
    """Draws of the posterior as a chain has them.

    They are of the Laplace approximation, resampled by the posterior's own density.
    """
    estimate = bf.find_map(target)
    rng = np.random.default_rng(seed)
    proposal = stats.multivariate_t(estimate.params, estimate.covariance * 1.2, df=8, seed=rng)
    points = proposal.rvs(20 * n).reshape(20 * n, -1)
    weight = target.log_prob(points) - proposal.logpdf(points)
    kept = points[rng.choice(len(points), n, replace=False, p=np.exp(weight - logsumexp(weight)))]
    chain = kept.reshape(4, 20, -1, target.n_parameters)
    return SimpleNamespace(
        chain=chain, burn_in=0, parameter_names=target.parameter_names,
        draws=lambda: kept, posterior=lambda: target,
    )  # fmt: skip


@pytest.fixture(scope="module")
def right() -> Any:
    return drawn(posterior(TERM))


def test_elpd_is_that_of_refits_without_the_pixel(right: Any) -> None:
    """The pixel where the source is steepest, and one far away, are left out of another fit."""
    target = right.posterior()
    compared = compare({"a": right, "b": right}, draws=2000)
    every = pointwise(target, right)
    assert compared.scores[0].elpd == pytest.approx(every.sum(), abs=0.05)
    for pixel in ((12, 4), (12, 8), (0, 0)):
        mask = np.ones((25, 25), bool)
        mask[pixel] = False
        refit = drawn(posterior(TERM, mask=mask), seed=2)
        mu = np.array([target.expected_counts(draw)[pixel] for draw in refit.draws()])
        truth = np.log(np.mean(stats.poisson.pmf(target.counts[pixel], mu)))
        # both from 2,000 draws, of a log-density that varies by 0.3 at the most
        assert every.reshape(25, 25)[pixel] == pytest.approx(truth, abs=0.03)


def pointwise(target: bf.Posterior, chain: Any) -> Floats:
    """Leave-one-out without smoothing: the harmonic mean of a pixel's density over the draws."""
    mu = np.array([target.expected_counts(draw).ravel() for draw in chain.draws()])
    values = stats.poisson.logpmf(target.counts.ravel(), mu)
    assert np.ptp(values, axis=0).max() > SPREAD  # some pixels go the way of smoothing
    return np.asarray(np.log(len(mu)) - logsumexp(-values, axis=0))


def test_effective_parameters_are_counted(right: Any) -> None:
    """Of a right model it is the number of parameters, up to the scatter of the frame: 2 +- 1."""
    assert compare({"a": right, "b": right}).scores[0].p_loo == pytest.approx(2.0, abs=1.0)


def test_missing_term_is_missed_and_needless_one_is_not_chosen(right: Any) -> None:
    without, with_more = drawn(posterior(OTHER)), drawn(posterior(TERM, OTHER))
    compared = compare({"without": without, "more": with_more, "right": right})
    scores = {s.name: s for s in compared.scores}
    assert compared.chosen == "right"
    assert compared.reliable
    assert scores["without"].difference > max(4.0, 2.0 * scores["without"].difference_se)
    assert abs(scores["more"].elpd - scores["right"].elpd) < 4.0
    assert [s.n_parameters for s in (scores["more"], scores["right"])] == [3, 2]
    assert compared.scores[0].difference == 0.0


def test_difference_is_less_uncertain_than_its_parts(right: Any) -> None:
    """Pixels that both models predict alike cancel.

    The negative control adds the two models' errors instead.
    """
    more = drawn(posterior(TERM, OTHER))
    last = compare({"more": more, "right": right}).scores[1]
    assert last.difference_se < 0.1 * np.hypot(last.elpd_se, last.elpd_se)


def test_draw_that_is_decided_by_one_pixel_is_said_to_be_unreliable() -> None:
    """A hot pixel on the flank of a bright source moves the whole posterior."""
    counts = bf.simulate(forward(TERM, flux=200.0), TRUTH[:1], TRUTH[1], seed=3)
    counts[12, 9] += 400.0
    target = bf.Posterior(forward(TERM, flux=200.0), counts)
    chain = drawn(target)
    assert not compare({"a": chain, "b": chain}).reliable
    assert compare({"a": chain, "b": chain}).scores[0].pareto_k > 0.7


def test_what_cannot_be_compared_is_refused(right: Any) -> None:
    with pytest.raises(bf.InputError, match="at least two"):
        compare({"a": right})
    with pytest.raises(bf.InputError, match="draws: got 10"):
        compare({"a": right, "b": right}, draws=10)
    target = right.posterior()
    other = SimpleNamespace(posterior=lambda: bf.Posterior(target.model, target.counts + 1.0))
    with pytest.raises(bf.InputError, match="other: counts"):
        compare({"a": right, "other": other})
    mask = np.ones((25, 25), bool)
    mask[0, 0] = False
    other = SimpleNamespace(posterior=lambda: bf.Posterior(target.model, target.counts, mask=mask))
    with pytest.raises(bf.InputError, match="other: mask"):
        compare({"a": right, "other": other})
    other = SimpleNamespace(
        posterior=lambda: bf.Posterior(
            target.model, target.counts, nuisances=bf.Nuisances(flux="free")
        )
    )
    with pytest.raises(bf.InputError, match="other: fluxes: got free ones"):
        compare({"a": right, "other": other})


def test_command_ranks_chain_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, terms in (("right", [TERM]), ("wrong", [OTHER])):
        bf.sample(posterior(*terms), path=f"{name}.h5", seed=1, target_ess=200, progress=False)
    result = CliRunner().invoke(app, ["compare", "wrong.h5", "right.h5"])
    assert result.exit_code == 0
    assert result.output.index("right.h5") < result.output.index("wrong.h5")
    assert "chosen: right.h5" in result.output
    for arguments, said in (
        (["right.h5"], "at least two"),
        (["right.h5", "right.h5"], "twice"),
        (["right.h5", "no.h5"], "no.h5"),
    ):
        refused = CliRunner().invoke(app, ["compare", *arguments])
        assert refused.exit_code == 2
        assert said in refused.output and "Traceback" not in refused.output

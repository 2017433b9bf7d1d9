"""Displacements that neighbouring sources have in common: the field, and errors that hold."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special
from scipy.spatial.distance import cdist
from test_sampling_chain import reseal

import bayesfred as bf
from bayesfred.analysis import random_field
from bayesfred.analysis.displacements import displacement_lines, widening
from bayesfred.analysis.random_field import (
    FieldLeft,
    Placed,
    find_field,
    placed,
    shared_products,
)
from bayesfred.analysis.residuals import judge_residuals
from bayesfred.analysis.score_tests import ScoreTests, score_tests
from bayesfred.analysis.sources import fit_sources
from bayesfred.analysis.verdict import judge_fit
from bayesfred.commands.pipeline import with_displacements
from bayesfred.model.displacement_errors import DisplacementErrors, RandomField
from bayesfred.optimize.fit_statistics import fit_statistics
from bayesfred.sampling.frame_moves import FrameMove

Floats = NDArray[np.float64]

LISTED, LENS = bf.SourceCatalog.grid(10, 14.7, 2e4), bf.PolynomialDistortion.polynomial(2)
SCATTERS = bf.Nuisances("free", offset=True, position_scatter=True)
TRUE = RandomField(0.03, 20.0)


def field_of(places: Floats, field: RandomField, rng: np.random.Generator) -> Floats:
    """Displacements of that field with the scatter of each source, shape (n, 2)."""
    lower = np.linalg.cholesky(
        field.covariance(cdist(places, places)) + 1e-12 * np.eye(len(places))
    )
    moved = lower @ rng.standard_normal(places.shape)
    return np.asarray(moved + field.scatter * rng.standard_normal(places.shape))


def pinholes(seed: int, field: RandomField) -> bf.Posterior:
    """A target of 100 marks that are displaced by such a field, and listed where they should be."""
    rng, detector, psf = np.random.default_rng(seed), bf.Detector((160, 160)), bf.GaussianPSF(1.6)
    places = np.column_stack([LISTED.x, LISTED.y])
    x, y = (places + field_of(places, field, rng)).T
    drilled = bf.ForwardModel(detector, replace(LISTED, x=x, y=y), psf, LENS)
    counts = bf.simulate(drilled, np.zeros(LENS.n_terms), 20.0, seed=seed)
    return bf.Posterior(bf.ForwardModel(detector, LISTED, psf, LENS), counts, nuisances=SCATTERS)


def made_up(n: int, field: RandomField, rng: np.random.Generator, terms: int = 3) -> Placed:
    """Sources whose positions are known to 0.01 px, and the field's displacements."""
    images = rng.uniform(-150.0, 150.0, (n, 2))
    powers = np.stack([(images[:, 0] / 150.0) ** k for k in range(terms)], axis=1)
    slopes = np.zeros((n, 2, 2 * terms))
    slopes[:, 0, :terms], slopes[:, 1, terms:] = powers, powers
    found = field_of(images, field, rng) + 0.01 * rng.standard_normal((n, 2))
    each = np.tile(np.eye(2), (n, 1, 1))
    return Placed(np.arange(n), images, found, 1e-4 * each, 4e-4 * each, slopes)


# --- the field ------------------------------------------------------------------------------------


def test_the_covariance_is_materns() -> None:
    r, nu = np.linspace(0.1, 80.0, 50), 1.5
    q = np.sqrt(2.0 * nu) * r / 13.0
    general = 2.0 ** (1.0 - nu) / special.gamma(nu) * q**nu * special.kv(nu, q)
    assert RandomField(0.2, 13.0).covariance(r) == pytest.approx(0.04 * general, rel=1e-12)


def test_the_field_is_found() -> None:
    """30 fields of 300 sources: logarithms of sd, length and scatter within 4 Monte Carlo errors.

    The control: a trend that is not integrated out takes a part of the field.
    """
    rng, true, logs, without = np.random.default_rng(950), RandomField(0.03, 30.0, 0.02), [], []
    for _ in range(30):
        sources = made_up(300, true, rng, 4)
        values = [sources.found[:, k] for k in range(2)]
        design = sources.slopes[:, 0, :4]
        left = [y - design @ np.linalg.lstsq(design, y)[0] for y in values]
        sources = sources._replace(found=np.column_stack(left))
        field = find_field(sources, sources.slopes)
        blind = find_field(sources, sources.slopes[:, :, :0])
        assert field is not None and blind is not None
        logs.append(np.log(np.divide(field, true)))
        without.append(np.log(np.divide(blind, true)))
    means, sd = np.mean(logs, axis=0), np.std(logs, axis=0) / 30**0.5
    assert np.all(np.abs(means) < 4.0 * sd), (means, sd)
    assert np.mean(without, axis=0)[0] < -5.0 * sd[0]


def test_blocks_tell_what_all_sources_together_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, true = np.random.default_rng(951), RandomField(0.03, 20.0, 0.01)
    sources = made_up(700, true, rng)
    blocks = find_field(sources, sources.slopes)
    monkeypatch.setattr(random_field, "BLOCK", 700)
    whole = find_field(sources, sources.slopes)
    assert blocks is not None and whole is not None
    assert np.log(blocks) == pytest.approx(np.log(whole), abs=0.15)


def test_independent_sources_have_no_field() -> None:
    """Of 300, with normal and with heavy tails, at most 15 by chance (5 % at 4, and 4 errors)."""
    rng, found = np.random.default_rng(952), 0
    for k in range(300):
        sources = made_up(40, RandomField(0.03, 30.0), rng)
        moved = rng.standard_normal((40, 2)) if k % 2 else rng.standard_t(3.0, (40, 2))
        scattered = sources._replace(found=0.03 * moved)
        found += find_field(scattered, sources.slopes) is not None
    assert found <= 15 + 4 * 15**0.5


def test_no_field_without_sources() -> None:
    rng = np.random.default_rng(953)
    sources = made_up(40, RandomField(0.03, 60.0), rng)
    assert find_field(sources, sources.slopes) is not None
    few = Placed(*(column[:19] for column in sources))
    assert find_field(few, few.slopes) is None
    on_a_line = sources._replace(images=sources.images * [1.0, 0.0])
    assert find_field(on_a_line, sources.slopes) is None
    powers = (sources.images[:, :1] / 150.0) ** np.arange(30)
    trend = np.zeros((40, 2, 60))
    trend[:, 0, :30], trend[:, 1, 30:] = powers, powers
    assert find_field(sources, trend) is None


def test_sums_over_pairs_are_those_of_the_whole_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, field = np.random.default_rng(954), RandomField(0.03, 20.0, 0.01)
    sources, moves = made_up(60, field, rng), rng.standard_normal((60, 2, 5))
    whole = field.covariance(cdist(sources.images, sources.images))
    np.fill_diagonal(whole, field.sd**2 + field.scatter**2 - 4e-4)
    expected = sum(moves[:, k].T @ whole @ moves[:, k] for k in range(2))
    monkeypatch.setattr(random_field, "ROWS", 17)
    found = shared_products(field, sources, moves)
    # beyond six lengths the field is not followed: at most 4e-4 of its variance a pair
    assert found == pytest.approx(expected, abs=2e-4 * np.abs(expected).max())
    monkeypatch.setattr(random_field, "REACH", 100.0)
    assert shared_products(field, sources, moves) == pytest.approx(expected, rel=1e-10, abs=1e-12)


def test_what_a_fit_leaves_is_that_of_its_residuals() -> None:
    rng, field = np.random.default_rng(955), RandomField(0.05, 40.0)
    sources = made_up(50, field, rng)
    pulls = sources.pulls.reshape(100, -1)
    covariance = np.linalg.inv(sources.slopes.reshape(100, -1).T @ pulls)
    left = np.eye(100) - sources.slopes.reshape(100, -1) @ covariance @ pulls.T
    whole = field.covariance(cdist(sources.images, sources.images))
    np.fill_diagonal(whole, field.sd**2 - 4e-4)
    both = np.zeros((50, 2, 50, 2))
    for k in range(2):
        both[:, k, :, k] = whole
    both = (left @ both.reshape(100, 100) @ left.T).reshape(50, 2, 50, 2)
    pairs = np.array([[1, 2], [7, 33], [40, 12]])
    expected = [both[pairs[:, 0], k, pairs[:, 1], k] for k in range(2)]
    found = FieldLeft(field, sources, covariance)(pairs)
    assert found == pytest.approx(np.array(expected), abs=1e-6)


# --- errors that hold -----------------------------------------------------------------------------


def test_what_displacements_do_to_the_gradient() -> None:
    """Sources that are moved by a little, one after the other, where none scatters."""
    posterior = pinholes(1, RandomField(1e-6, 20.0))
    fixed = replace(posterior, nuisances=bf.Nuisances("free"), prior={})
    params = bf.find_map(fixed).params
    sources = placed(fixed, params, fit_sources(fixed, params))
    slopes, step = [], 0.02
    kept = [k for k, p in enumerate(fixed.parameters) if p.kind == "distortion"]
    for s in (3, 47, 95):
        x = LISTED.x.copy()
        x[s] += step
        other = replace(fixed, model=replace(fixed.model, sources=replace(LISTED, x=x)))
        # a catalogue that is off by a step moves the fit against a displacement
        slopes.append((fixed.gradient(params) - other.gradient(params))[kept] / step)
    found = sources.pulls[[3, 47, 95], 0][:, kept]
    for one, other_one in zip(found, slopes, strict=True):
        assert one == pytest.approx(other_one, rel=0.05, abs=0.02 * np.abs(one).max())
    best = bf.find_map(posterior)
    scattered = placed(posterior, best.params, fit_sources(posterior, best.params))
    # with these weights the information is that of the fit
    covariance = scattered.errors + scattered.scatter
    told = np.einsum("nak,nab,nbl->kl", scattered.pulls, covariance, scattered.pulls)
    for name in ("f_x", "g_xy", "offset_x"):
        k = posterior.parameter_names.index(name)
        assert told[k, k] == pytest.approx(posterior.fisher(best.params)[k, k], rel=0.01)


class Fitted(NamedTuple):
    """Frames with such a field, a row each."""

    plain: Floats  # coefficients over their errors without the field
    wider: Floats  # and with it
    p: Floats  # of the halves
    scores: Floats  # of missing terms without the field
    wider_scores: Floats


def fitted(n: int, field: RandomField) -> Fitted:
    rows = []
    for seed in range(n):
        posterior = pinholes(seed, field)
        best = bf.find_map(posterior)
        widened, other, _ = with_displacements(posterior, best)
        z = [e.params / np.sqrt(np.diag(e.covariance)) for e in (best, other)]
        scores = [score_tests(each, best.params) for each in (posterior, widened)]
        terms = [name.startswith(("f_", "g_")) for name in scores[0].names]
        p = bf.cross_check(widened, estimate=other).displacement_p
        rows.append((*(each[: LENS.n_terms] for each in z), p, *(s.z[terms] for s in scores)))
    return Fitted(*(np.array(column) for column in zip(*rows, strict=True)))


def mean_and_error(z: Floats, limit: float) -> tuple[float, float]:
    """The share of z below a limit, with its Monte Carlo error: frames are independent."""
    shares = np.mean(np.abs(z) < limit, axis=1)
    return float(shares.mean()), float(shares.std() / len(z) ** 0.5)


@pytest.mark.slow
def test_errors_hold_where_neighbours_are_displaced_alike() -> None:
    """40 frames: 68 % and 95 % intervals within 3.5 Monte Carlo errors; without, far too narrow.

    Scores of missing terms are as wide or wider, by a quarter at most. The halves agree.
    """
    found = fitted(40, TRUE)
    for limit, share, widest in ((1.0, 0.683, 0.79), (1.96, 0.95, 0.986)):
        mean, error = mean_and_error(found.wider, limit)
        assert abs(mean - share) < 3.5 * error, (limit, mean, error)
        mean, error = mean_and_error(found.wider_scores, limit)
        assert share - 3.5 * error < mean < widest + 3.5 * error, (limit, mean, error)
    assert mean_and_error(found.plain, 1.0)[0] < 0.4
    assert mean_and_error(found.scores, 1.0)[0] < 0.55
    assert np.mean(found.p < 0.05) < 0.2 and np.mean(found.p > 0.95) < 0.2


@pytest.mark.slow
def test_nothing_is_added_where_sources_scatter_independently() -> None:
    """Of 40 frames at most 5 by chance."""
    found = fitted(40, RandomField(1e-6, 20.0, 0.03))
    assert np.sum(np.any(found.plain != found.wider, axis=1)) <= 5


@pytest.fixture(scope="module")
def widened() -> tuple[bf.Posterior, bf.MapEstimate, bf.Posterior, bf.MapEstimate]:
    posterior = pinholes(2, TRUE)
    best = bf.find_map(posterior)
    other, wider, lines = with_displacements(posterior, best)
    assert lines == displacement_lines(other, best.covariance) and len(lines) == 1
    assert lines[0].startswith("displacements: neighbouring sources are displaced alike, by 0.0")
    return posterior, best, other, wider


Widened = tuple[bf.Posterior, bf.MapEstimate, bf.Posterior, bf.MapEstimate]


def test_draws_and_maximum_have_the_wider_errors(widened: Widened, tmp_path: Path) -> None:
    posterior, best, other, wider = widened
    added = other.displacement_errors
    assert added is not None
    assert np.linalg.eigvalsh(added.covariance / np.outer(*2 * [_scale(best)])).min() > -1e-9
    assert bf.find_map(other, best.params).covariance == pytest.approx(wider.covariance, rel=1e-2)
    path = tmp_path / "chain.h5"
    chain = bf.laplace(other, wider, seed=1, path=path, progress=False)
    narrow = bf.laplace(posterior, best, seed=1, progress=False)
    some = slice(0, LENS.n_terms)
    after, before = (each.draws()[:, some] for each in (chain, narrow))
    off = after.var(axis=0) - before.var(axis=0) - np.diag(added.covariance)[some]
    error = (2.0 / len(after)) ** 0.5 * after.var(axis=0)  # Monte Carlo
    assert np.all(np.abs(off) < 4.0 * error)
    assert np.all(np.diag(added.covariance)[some] > 10.0 * error)
    read = bf.open_chain(path).posterior().displacement_errors
    assert read is not None and read.field == added.field
    assert np.array_equal(read.covariance, added.covariance)
    # the same in one that is stored as files were before
    with h5py.File(path, "r+") as file:
        file.attrs["schema"] = 9
        del file["posterior/displacement_errors"]
    reseal(path)
    assert bf.open_chain(path).posterior().displacement_errors is None


def _scale(estimate: bf.MapEstimate) -> Floats:
    return np.sqrt(np.diag(estimate.covariance))


def test_the_checks_know_of_the_field(widened: Widened) -> None:
    posterior, best, other, wider = widened
    before = judge_residuals(posterior, best.params, best.covariance)
    after = judge_residuals(other, wider.params, wider.covariance)
    assert before.neighbours is not None and before.neighbours.alike
    assert after.neighbours is not None and not after.neighbours.alike
    assert after.neighbours.expected > 5.0 * after.neighbours.sd
    # what a fit absorbs is no matter of displacements
    assert np.array_equal(before.tests.failed, after.tests.failed)
    assert before.phases[0].chi2 == pytest.approx(after.phases[0].chi2, rel=1e-9)
    alone = bf.cross_check(posterior, estimate=best)
    assert alone.verdict == "too small" and "which both halves have in common" in alone.message
    assert bf.cross_check(other, estimate=wider).verdict == "right"
    said = "Neighbouring sources are displaced alike, by 0.0"
    for each, residuals in ((posterior, before), (other, after)):
        fit = fit_statistics(each, best.params)
        verdict = judge_fit(each, best, fit, residuals)
        assert verdict.fits_data == (each is other)
        assert (said in verdict.sentence) == (each is other)


def test_scores_of_missing_terms_have_the_fields_variance(widened: Widened) -> None:
    posterior, best, other, _ = widened
    before, after = score_tests(posterior, best.params), score_tests(other, best.params)
    assert before.shared is None and after.shared is not None
    assert np.array_equal(before.information, after.information)
    terms = np.array([name.startswith(("f_", "g_")) for name in before.names])
    wider = np.diag(after.covariance) / np.diag(before.covariance)
    assert np.all(wider[terms] > 1.5)
    assert wider[~terms] == pytest.approx(1.0, abs=0.01)
    for one, two in zip(before.checks[:-1], after.checks[:-1], strict=True):
        assert one.value == two.value  # the step


def test_leads_with_displacements_in_common() -> None:
    """Two numbers whose scores share a displacement: the second is no lead beside the first."""
    information = np.array([[100.0, 0.0], [0.0, 100.0]])
    shared = 9.0 * np.array([[100.0, 90.0], [90.0, 100.0]])
    tested, score = np.ones(2, dtype=bool), np.array([200.0, 190.0])
    names, values = ("psf_sigma", "offset_x"), np.zeros(2)
    plain = ScoreTests(names, values, score, information, tested)
    wide = ScoreTests(names, values, score, information, tested, shared)
    assert [lead.name for lead in plain.leading] == list(names)
    (lead, other) = wide.leading
    assert lead.z == pytest.approx(200.0 / 1000.0**0.5) and lead.step == pytest.approx(2.0)
    assert other.z == pytest.approx(190.0 / 1000.0**0.5)


def test_positions_have_to_scatter() -> None:
    posterior = pinholes(3, TRUE)
    fixed = replace(posterior, nuisances=bf.Nuisances("free"), prior={})
    with pytest.raises(bf.InputError, match="got positions that do not scatter, expected position"):
        bf.marginalize_displacements(fixed, bf.find_map(fixed))


def test_errors_of_other_parameters_are_refused(widened: Widened) -> None:
    _, _, other, _ = widened
    wrong = DisplacementErrors(("f_x",), np.eye(1))
    with pytest.raises(bf.InputError, match=r"displacement_errors: got those of f_x, expected"):
        replace(other, displacement_errors=wrong)
    with pytest.raises(bf.InputError, match=r"displacement_errors: got shape \(1, 1\), expected"):
        DisplacementErrors(("f_x", "g_y"), np.eye(1))


def test_frames_have_fields_of_their_own() -> None:
    """Two frames, one of which has a field: what it adds is shared as its information is."""
    frames = {"a": pinholes(5, TRUE), "b": pinholes(6, RandomField(1e-6, 20.0, 0.03))}
    joint = bf.JointPosterior(frames, LENS.names)
    best = bf.find_map(joint)
    other, wider, lines = with_displacements(joint, best)
    assert len(lines) == 1 and lines[0].startswith("a: displacements: neighbouring sources are")
    one, none = (other.frame(name).displacement_errors for name in "ab")
    assert one is not None and one.field is not None and none is not None and none.field is None
    total = other.displacement_errors
    assert total is not None and total.field is None
    own = other.frames["a"].displacement_errors
    assert own is not None and other.frames["b"].displacement_errors is None
    shared = slice(0, len(LENS.names))
    ratio = np.diag(total.covariance)[shared] / np.diag(own.covariance)[shared]
    assert np.all((ratio > 0.05) & (ratio < 0.8))  # a quarter if both frames told as much
    assert np.array_equal(one.covariance, other.frame_covariance("a", total.covariance))
    moves = (FrameMove.of(j, e, j.log_parts) for j, e in ((other, wider), (joint, best)))
    one_lower, two_lower = (move.shared.lowers for move in moves)
    assert np.ravel(one_lower) == pytest.approx(np.ravel(two_lower), rel=1e-6, abs=1e-12)
    found = bf.cross_check(other, estimate=wider)
    assert found.verdict != "too small"
    chain = bf.laplace(other, wider, seed=1, progress=False)
    part = chain.frame("a")
    assert part.posterior().displacement_errors.field == one.field
    assert bf.diagnose(chain).frames["a"].residuals.neighbours.expected > 0.0


def test_a_field_makes_no_errors_smaller(widened: Widened) -> None:
    """Directions along which displacements would cancel keep their errors, the others theirs."""
    posterior, best, _, _ = widened
    moved = [k for k, name in enumerate(posterior.parameter_names) if name != "position_scatter"]
    block = np.ix_(moved, moved)
    information = posterior.information(best.params)
    lower = np.linalg.cholesky(information[block])
    axes = np.linalg.qr(np.random.default_rng(956).standard_normal(lower.shape))[0]
    values, slopes = np.linspace(-0.5, 2.0, len(axes)), np.zeros_like(information)
    slopes[block] = lower @ (axes * values) @ axes.T @ lower.T
    added = widening(posterior, best.params, slopes)[block]
    found = np.linalg.eigvalsh(lower.T @ added @ lower)
    assert found == pytest.approx(np.maximum(values, 0.0), abs=0.02)

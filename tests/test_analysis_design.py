"""Designs before the exposure.

Choices against all subsets, predicted errors against closed forms and refits of simulated frames,
pointings against the joint information of all their parameters.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from threadpoolctl import threadpool_limits

import bayesfred as bf
from bayesfred.analysis.design import Design, design
from bayesfred.analysis.field import displacement_covariance, field_points
from bayesfred.analysis.optimal import Criterion, Field, Information, exchange, search
from bayesfred.analysis.photons import laplace_error
from bayesfred.analysis.planned import by_pointing, by_source, planned, shared_field
from bayesfred.errors import InputError
from bayesfred.optimize.estimate import inverse
from bayesfred.optimize.newton import maximize
from bayesfred.reporting.design import design_plot
from bayesfred.reporting.style import png

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FREE = bf.Nuisances(flux="free", offset=True, psf_sigma=True)


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Small matrices are slower in several threads."""
    with threadpool_limits(1, user_api="blas"):
        yield


def small(
    side: int = 3, flux: float = 2e4, spacing: float = 20.0, **options: Any
) -> tuple[bf.Posterior, Floats]:
    """A grid of sources, 65 x 65 pixels, all terms of second order."""
    model = bf.ForwardModel(
        bf.Detector((65, 65)), bf.SourceCatalog.grid(side, spacing, flux), bf.GaussianPSF(2.0),
        options.pop("distortion", bf.PolynomialDistortion.polynomial(2)),
    )  # fmt: skip
    terms = model.distortion.n_terms
    theta = np.linspace(1.0, -1.0, terms) * 1e-3 / 32.0
    posterior = bf.Posterior(model, bf.simulate(model, theta, 5.0, seed=1), **options)
    known = {"background": 5.0, "psf_sigma": 2.0, "flux_scale": 1.0}
    others = [known.get(name, 0.0) for name in posterior.parameter_names[terms:]]
    return posterior, np.array([*theta, *others])


def judge(known: Information, numbers: Ints) -> float:
    """The criterion by its definition: a volume's root per coefficient, or an error; less is best.

    One over the first is the number of times fewer photons for which a design is as good.
    """
    covariance = np.linalg.inv(known.base + sum(known.parts[np.flatnonzero(numbers)]))
    block = covariance[np.ix_(known.wanted, known.wanted)]
    if known.criterion == "D":
        return float(np.linalg.det(block) ** (1.0 / len(block)))
    return max(
        float(0.5 * np.trace(at @ covariance @ at.T)) for at in known.field.derivatives
    )  # fmt: skip


def best(known: Information, number: int) -> float:
    """The criterion of the best subset, by trying all."""
    n = len(known.parts)
    subsets = itertools.combinations(range(n), number)
    return min(judge(known, np.bincount(subset, minlength=n)) for subset in subsets)


def problem(criterion: Criterion, posterior: bf.Posterior, params: Floats) -> Information:
    plan = planned(posterior, params)
    _, parts = by_source(plan, params)
    points = field_points(plan, params)
    inside = points.weights > 0.0
    theta = params[: plan.model.distortion.n_terms]
    slopes = plan.model.polynomial.displacement_jacobian(theta, points.u[inside], points.v[inside])[
        :, :, : theta.size
    ]
    field = np.zeros((len(slopes), 2, params.size))
    field[:, :, : theta.size] = slopes
    return Information.scaled(
        plan.prior_information(params), parts, np.arange(theta.size),
        Field(field, points.weights[inside]), criterion,
    )  # fmt: skip


def random_problem(seed: int, criterion: Criterion) -> Information:
    """Twelve candidates that tell of two directions each, four coefficients and a nuisance."""
    rng = np.random.default_rng(seed)
    factors = rng.standard_normal((12, 5, 2)) * rng.lognormal(0.0, 0.7, (12, 1, 1))
    field = Field(rng.standard_normal((9, 2, 5)) * [1.0, 1.0, 1.0, 1.0, 0.0], np.ones(9))
    parts = factors @ factors.swapaxes(1, 2)
    return Information(1e-3 * np.eye(5), parts, np.arange(4), field, criterion)


# --- the search -----------------------------------------------------------------------------------


@pytest.mark.parametrize("criterion", ["D", "G"])
@pytest.mark.parametrize("number", [3, 4, 6])
def test_choices_of_sources_are_the_best_of_all_subsets(criterion: Criterion, number: int) -> None:
    """9 sources: 84 or 126 subsets. Within 1 % of the best, as photons count."""
    known = problem(criterion, *small())
    assert best(known, number) >= 0.99 * judge(known, search(known, number))


@pytest.mark.parametrize("criterion", ["D", "G"])
def test_the_search_in_random_problems(criterion: Criterion) -> None:
    """40 problems with 495 subsets each: nothing is certain but a local optimum.

    Nearly all are within 1 % of the best. The control: of single exchanges from the first four
    fewer are, for G.
    """
    found, once = [], []
    for seed in range(40):
        known = random_problem(seed, criterion)
        least = best(known, 4)
        found.append(least / judge(known, search(known, 4)))
        first = exchange(known, np.bincount([0, 1, 2, 3], minlength=12))
        once.append(least / judge(known, first))
    assert max(found) < 1.0 + 1e-9  # nothing is better than the best
    assert np.mean(np.array(found) > 0.99) >= 0.95
    if criterion == "G":
        assert np.mean(np.array(once) > 0.99) < np.mean(np.array(found) > 0.99)


@pytest.mark.parametrize("criterion", ["D", "G"])
def test_no_replacement_of_one_member_improves_an_exchange(criterion: Criterion) -> None:
    for seed in range(5):
        known = random_problem(seed, criterion)
        numbers = exchange(known, np.bincount([0, 1, 2, 3], minlength=12))
        assert numbers.sum() == 4
        value = judge(known, numbers)
        for out, into in itertools.product(np.flatnonzero(numbers), np.flatnonzero(numbers == 0)):
            swapped = numbers.copy()
            swapped[[out, into]] = 0, 1
            assert judge(known, swapped) > value * (1.0 - 1e-7)


@pytest.mark.parametrize("criterion", ["D", "G"])
def test_candidates_are_judged_as_by_definition(criterion: Criterion) -> None:
    known = random_problem(3, criterion)
    before = np.bincount([0, 5], minlength=12)
    values = known.values(known.of(before))
    naive = []
    for k in range(2, 12):
        if k != 5:
            naive.append(judge(known, before + np.bincount([k], minlength=12)))
    rows = [k for k in range(2, 12) if k != 5]
    power = 4.0 if criterion == "D" else 1.0  # the determinant is of four coefficients
    difference = values[rows] + power * np.log(naive)
    np.testing.assert_allclose(difference, difference[0], atol=1e-10)
    if criterion == "G":
        np.testing.assert_allclose(difference, 0.0, atol=1e-10)


# --- sources --------------------------------------------------------------------------------------


def test_sources_add_up_to_the_frame() -> None:
    """Exactly where fluxes are not free; to less where they are.

    But for the fluxes' prior, which counts once for each source whose pixels a flux lights. The
    control: sources counted twice are not the frame.
    """
    for nuisances in (bf.Nuisances(), bf.Nuisances(flux="scale", background_order=1)):
        posterior, params = small(nuisances=nuisances)
        plan = planned(posterior, params)
        seen, parts = by_source(plan, params)
        assert seen.tolist() == list(range(9))
        shares = np.linalg.eigvals(np.linalg.solve(plan.fisher(params), parts.sum(axis=0))).real
        np.testing.assert_allclose(shares, 1.0, atol=1e-4)
        doubled = np.linalg.eigvals(np.linalg.solve(plan.fisher(params), 2.0 * parts.sum(axis=0)))
        assert np.abs(doubled - 1.0).min() > 0.9
    posterior, params = small(5, spacing=12.0, nuisances=FREE)
    plan = planned(posterior, params)
    _, parts = by_source(plan, params)
    whole, added = (
        m + plan.prior_information(params) for m in (plan.fisher(params), parts.sum(axis=0))
    )
    shares = np.linalg.eigvals(np.linalg.solve(whole, added)).real
    assert shares.min() > 0.3 and shares.max() < 1.001


@pytest.mark.parametrize("spacing", [12.0, 20.0])
def test_a_target_of_the_chosen_alone_is_about_as_predicted(spacing: float) -> None:
    """Sources six or ten widths apart: right to a few per cent, and not too optimistic."""
    posterior, params = small(5 if spacing < 15.0 else 3, spacing=spacing, nuisances=FREE)
    plan = design(posterior, params, sources=6)
    assert plan.exact_rms == pytest.approx(plan.sources.chosen_rms, rel=0.05)
    assert plan.exact_rms < 1.005 * plan.sources.chosen_rms


def test_one_scale_and_two_stars_in_closed_form() -> None:
    """f = theta x, g = theta y: a star at (x, y) tells theta by F^2 (x^2 + y^2) / (8 pi s^4 V).

    With Gaussian noise of variance V. The error at (u, v) is that of theta times
    sqrt((u^2 + v^2) / 2). The star at twice the distance tells four times as much.
    """
    flux, sigma, variance, x = 3e3, 2.5, 9.0, np.array([-20.0, 10.0])
    scale = bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)], [[1.0], [1.0]], "scale")
    model = bf.ForwardModel(
        bf.Detector((65, 65)), bf.SourceCatalog(x, [0.0, 0.0], [flux, flux]), bf.GaussianPSF(sigma),
        scale,
    )  # fmt: skip
    posterior = bf.Posterior(
        model, model.expected_counts([0.0], 5.0), noise=bf.GaussianNoise(variance),
        prior={"scale": stats.norm(0.0, 1e3)},
    )  # fmt: skip
    plan = design(posterior, [0.0, 5.0])
    each = flux**2 * x**2 / (8.0 * math.pi * sigma**4 * variance)
    sd = np.sqrt(0.5 * (plan.points.u**2 + plan.points.v**2) / each.sum())
    np.testing.assert_allclose(plan.sd, sd, rtol=1e-4, atol=1e-12)
    assert plan.sources.order.tolist() == [0, 1]
    assert plan.sources.rms[1] == pytest.approx(
        plan.sources.rms[0] * math.sqrt(4.0 / 5.0), rel=1e-4
    )


def test_the_counts_do_not_matter() -> None:
    """Two frames of one model, one of them bright, and free fluxes: the same design."""
    posterior, params = small(nuisances=FREE)
    other = replace(posterior, counts=posterior.counts + 300.0)
    one, two = (design(p, params, dithers=[(0.0, 0.0)]) for p in (posterior, other))
    np.testing.assert_array_equal(one.sd, two.sd)
    np.testing.assert_array_equal(one.sources.order, two.sources.order)
    assert one.lines == two.lines
    # an information at the fluxes of the counts would differ: what the test has to see
    assert np.abs(posterior.fisher(params) / other.fisher(params) - 1.0).max() > 0.1


def test_errors_are_those_of_the_package() -> None:
    posterior, params = small(nuisances=bf.Nuisances(offset=True))
    plan = design(posterior, params)
    free = planned(posterior, params)
    points = field_points(free, params)
    covariance = displacement_covariance(
        free, params, inverse(free.information(params)), points.u, points.v
    )
    sd = np.sqrt(0.5 * np.trace(covariance, axis1=-2, axis2=-1))
    np.testing.assert_allclose(plan.sd, sd, rtol=1e-10)
    assert plan.error_rms == pytest.approx(laplace_error(free, params, points), rel=1e-10)
    assert plan.error_largest == pytest.approx(sd[points.weights > 0.0].max(), rel=1e-10)
    assert plan.sources.rms[-1] == pytest.approx(plan.error_rms, rel=1e-3)
    assert np.all(np.diff(plan.sources.rms) < 0.0)


def test_fewer_sources_reach_an_error_than_at_random() -> None:
    posterior, params = small(5, spacing=12.0)
    found = design(posterior, params)
    middle = float(found.sources.rms[9])
    plan = design(posterior, params, error=middle)
    assert plan.sources.needed == 10 == len(plan.sources.chosen)
    assert np.flatnonzero(plan.random_rms <= middle)[0] + 1 > 10
    assert f"10 of 25 sources reach {middle:g} px rms" in plan.lines[1]
    never = design(posterior, params, error=0.1 * found.error_rms)
    assert never.sources.needed == math.inf
    assert len(never.sources.chosen) == 25
    assert never.photons.factor == pytest.approx(100.0, rel=0.5)


# --- against refits -------------------------------------------------------------------------------


def refitted(posterior: bf.Posterior, params: Floats, frames: int) -> Floats:
    """Errors of the displacement at the points that count, shape (frames, points, 2)."""
    plan, rng = planned(posterior, params), np.random.default_rng(5)
    points = field_points(plan, params)
    u, v = points.u[points.weights > 0.0], points.v[points.weights > 0.0]
    d = plan.model.polynomial
    out = np.zeros((frames, u.size, 2))
    for each in out:
        counts = plan.simulate(params, rng, plan.model.sources.flux)
        assert counts is not None
        found = maximize(replace(plan, counts=counts), params).params
        for sign, p in ((1.0, found), (-1.0, params)):
            x, y = d.object_position(p[: d.n_terms], u, v)
            each -= sign * np.stack([x, y], axis=-1)
    return out


def deviations(plan: Design, errors: Floats, covariance: Floats) -> tuple[float, float]:
    """How far mean squares over frames are from prediction, in their Monte Carlo errors.

    Over the field, and the farthest of its points. A quadratic form of normal errors with
    covariance C has the mean tr C and the variance 2 tr C^2, so that the mean over n frames has the
    error sqrt(2 tr C^2 / n). The field's C is that of all points.
    """
    n, counted = len(errors), plan.points.weights > 0.0
    covariance, w = covariance[counted], plan.points.weights[counted]
    w = w / w.sum()
    square = 0.5 * np.sum(errors**2, axis=-1).mean(axis=0)
    spread = 0.5 * np.sqrt(2.0 * np.sum(covariance**2, axis=(-1, -2)) / n)
    moving = spread > 1e-9 * spread.max()  # on the axis nothing is distorted
    z = ((square - plan.sd[counted] ** 2) / np.where(moving, spread, 1.0))[moving]
    flat = (errors * np.sqrt(0.5 * w)[:, None]).reshape(n, -1)
    gram = flat @ flat.T  # its off-diagonal squares estimate tr C^2
    trace = (np.sum(gram**2) - np.sum(np.diag(gram) ** 2)) / (n * (n - 1))
    whole = (np.sum(w * square) - plan.error_rms**2) / math.sqrt(2.0 * trace / n)
    return float(whole), float(np.abs(z).max())


@pytest.mark.slow
def test_predicted_errors_are_those_of_refits() -> None:
    """200 frames. The field's mean square within 4 Monte Carlo errors, each point's within 5.

    The control: with the sources counted twice the errors are too small by sqrt(2), which the same
    test rejects.
    """
    posterior, params = small(nuisances=bf.Nuisances(flux="free", psf_sigma=True))
    plan = design(posterior, params)
    free = planned(posterior, params)
    covariance = displacement_covariance(
        free, params, inverse(free.information(params)), plan.points.u, plan.points.v
    )
    errors = refitted(posterior, params, 200)
    whole, worst = deviations(plan, errors, covariance)
    assert abs(whole) < 4.0 and worst < 5.0
    doubled = replace(plan, sd=plan.sd / math.sqrt(2.0), error_rms=plan.error_rms / math.sqrt(2.0))
    whole, worst = deviations(doubled, errors, 0.5 * covariance)
    assert whole > 8.0 and worst > 8.0


@pytest.mark.statistics
def test_predicted_errors_are_those_of_a_noise_study(tmp_path: Path) -> None:
    """400 fits from the counts alone: the rms error over the field within 4 Monte Carlo errors."""
    posterior, params = small()
    terms = posterior.model.distortion.n_terms
    study = bf.noise_study(
        posterior.model, params[:terms], 5.0, replicates=400, path=tmp_path / "noise.ecsv", seed=2,
        workers=1, progress=False,
    )  # fmt: skip
    row = study.cells["parameter"] == "theta"
    found, error = (
        float(study.cells[name][row][0]) for name in ("displacement_rms", "displacement_rms_error")
    )
    plan = design(posterior, params)
    assert abs(found - plan.error_rms) < 4.0 * error
    assert abs(found - plan.error_rms / math.sqrt(2.0)) > 6.0 * error


# --- pointings ------------------------------------------------------------------------------------


def wide(posterior: bf.Posterior, width: float = 1.0) -> bf.Posterior:
    """The same with priors of the distortion that say nothing."""
    prior = dict(posterior.prior)
    for name in posterior.model.distortion.names:
        prior[name] = stats.norm(0.0, width)
    return replace(posterior, prior=prior)


def joint(posterior: bf.Posterior, params: Floats, pointings: Floats, shared: Ints) -> Floats:
    """Covariance of the shared terms from the information about all parameters of all frames."""
    plan = planned(posterior, params)
    own = np.setdiff1d(np.arange(params.size), shared)
    m, k = shared.size, own.size
    prior = plan.prior_information(params)
    whole = np.zeros((m + k * len(pointings),) * 2)
    whole[:m, :m] = prior[np.ix_(shared, shared)]
    s = plan.model.sources
    for j, (x, y) in enumerate(pointings):
        moved = replace(plan.model, sources=bf.SourceCatalog(s.x + x, s.y + y, s.flux))
        frame = bf.Posterior(
            moved, moved.expected_counts(params[: moved.distortion.n_terms], 5.0),
            prior=plan.prior, nuisances=plan.nuisances,
        )  # fmt: skip
        mine = np.arange(m + j * k, m + (j + 1) * k)
        told = frame.fisher(params)
        whole[:m, :m] += told[np.ix_(shared, shared)]
        whole[np.ix_(mine, mine)] = (told + prior)[np.ix_(own, own)]
        whole[np.ix_(mine, np.arange(m))] = told[np.ix_(own, shared)]
        whole[np.ix_(np.arange(m), mine)] = told[np.ix_(shared, own)]
    return inverse(whole)[:m, :m]


def test_frames_tell_what_all_their_parameters_together_do() -> None:
    """The sum over frames is the joint information of shared and own parameters.

    The control: own parameters that are shared, or fixed, are another information.
    """
    posterior, params = small(nuisances=bf.Nuisances(flux="scale", offset=True))
    pointings = np.array([(0.0, 0.0), (6.0, -3.0), (0.0, 0.0)])
    shared, prior, told = by_pointing(planned(posterior, params), params, pointings)
    names = [posterior.parameter_names[k] for k in shared]
    assert names == ["f_x2", "f_xy", "f_y2", "g_x2", "g_xy", "g_y2"]
    expected = joint(posterior, params, pointings, shared)
    np.testing.assert_allclose(inverse(prior + told.sum(axis=0)), expected, rtol=1e-6, atol=1e-18)
    fixed = planned(posterior, params).fisher(params)[np.ix_(shared, shared)]
    assert inverse(prior + 3.0 * fixed)[0, 0] < 0.9 * expected[0, 0]


def test_a_second_frame_at_the_same_pointing() -> None:
    """Errors go with the root of the number of frames, to the wanted one."""
    posterior, params = small(nuisances=bf.Nuisances(offset=True))
    plan = design(wide(posterior), params, error=1e-3, dithers=[(0.0, 0.0)], frames=4)
    assert plan.frames is not None
    one = float(plan.frames.rms[0])
    np.testing.assert_allclose(plan.frames.rms[:4], one / np.sqrt([1.0, 2.0, 3.0, 4.0]), rtol=1e-5)
    assert plan.frames.needed == math.ceil((one / 1e-3) ** 2)
    assert plan.frames.chosen.tolist() == [0, 0, 0, 0]
    assert plan.frames.chosen_rms == pytest.approx(0.5 * one, rel=1e-5)


def row_of_stars(nuisances: bf.Nuisances) -> tuple[bf.Posterior, Floats]:
    """Stars on the line y = 0, and terms in x^2 and y^2."""
    model = bf.ForwardModel(
        bf.Detector((65, 65)), bf.SourceCatalog([-24.0, -8.0, 8.0, 24.0], np.zeros(4), [2e4] * 4),
        bf.GaussianPSF(2.0), bf.PolynomialDistortion([(2, 0, 0, 0)], [(0, 2, 0, 0)]),
    )  # fmt: skip
    posterior = bf.Posterior(model, model.expected_counts([0.0, 0.0], 5.0), nuisances=nuisances)
    return posterior, np.array([0.0, 0.0, 5.0, *([0.0, 0.0] if nuisances.offset else [])])


def test_another_pointing_breaks_a_degeneracy() -> None:
    """At y = 0 nothing tells of y^2, however many frames; 20 pixels away one does.

    With an offset of its own the row of stars tells nothing anywhere, and two frames do not either:
    in each of them the term is a constant.
    """
    posterior, params = row_of_stars(bf.Nuisances())
    at_rest = design(posterior, params, dithers=[(0.0, 0.0)])
    assert at_rest.frames is not None
    assert at_rest.frames.needed == math.inf
    assert at_rest.frames.chosen_rms > 0.5
    both = design(posterior, params, dithers=[(0.0, 0.0), (0.0, 20.0)], criterion="G")
    assert both.frames is not None
    assert both.frames.order[0] == 1 and both.frames.needed < 5
    assert "1 frame reaches 0.01 px rms in the field that they share" in both.lines[3]
    posterior, params = row_of_stars(bf.Nuisances(offset=True))
    unknown = design(posterior, params, dithers=[(0.0, 0.0), (0.0, 20.0)], criterion="G", frames=9)
    assert unknown.frames is not None
    assert unknown.frames.largest[-1] > 0.1


def test_pointings_do_not_depend_on_the_basis() -> None:
    """Zernike's polynomials of third order have linear parts: the shared field is the same.

    The control: without taking the pose off, their errors differ.
    """
    plans, raw = [], []
    for distortion in (
        bf.PolynomialDistortion.polynomial(3),
        bf.PolynomialDistortion.zernike(3, radius=45.0),
    ):
        posterior, params = small(4, spacing=16.0, distortion=distortion)
        params[: distortion.n_terms] = 0.0
        posterior = wide(posterior, 1e3)
        plan = design(posterior, params, dithers=[(0.0, 0.0), (5.0, 5.0)], frames=3)
        plans.append(plan.frames)
        free = planned(posterior, params)
        points = field_points(free, params)
        shared, prior, told = by_pointing(free, params, np.zeros((1, 2)))
        inside = points.weights > 0.0
        slopes = free.model.polynomial.displacement_jacobian(
            params[: distortion.n_terms], points.u[inside], points.v[inside]
        )
        field = Field(np.pad(slopes[:, :, :-2], ((0, 0), (0, 0), (0, 1))), points.weights[inside])
        covariance = inverse(prior + told[0])
        raw.append(Field(field.derivatives[:, :, shared], field.weights).errors(covariance)[0])
        less = shared_field(free, field, shared).errors(covariance)[0]
        assert less < raw[-1]
    one, two = plans
    assert one is not None and two is not None
    np.testing.assert_allclose(one.rms, two.rms, rtol=1e-5)
    np.testing.assert_allclose(one.largest, two.largest, rtol=1e-5)
    assert abs(raw[0] / raw[1] - 1.0) > 0.1


# --- hostile input, and what is shown -------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"error": 0.0}, "error: got 0.0"),
        ({"error": math.nan}, "error: got nan"),
        ({"criterion": "A"}, "criterion: got 'A', expected D or G"),
        ({"sources": 0}, "sources: got 0, expected an integer from 1 to 9"),
        ({"sources": 10}, "sources: got 10, expected an integer from 1 to 9"),
        ({"frames": 0, "dithers": [(0.0, 0.0)]}, "frames: got 0"),
        ({"dithers": [(0.0, math.inf)]}, "dithers: got"),
        ({"sources": 2.5}, "sources: got 2.5"),
        ({"sources": True}, "sources: got True"),
        ({"dithers": [(0.0, 1.0, 2.0)]}, "dithers: got"),
        ({"dithers": [(0.0, 1.0), (2.0,)]}, "dithers: got"),
        ({"dithers": [(500.0, 0.0)]}, r"dithers: got \(500, 0\), where the frame shows no source"),
    ],
)
def test_bad_input_is_refused_in_one_line(options: dict[str, Any], told: str) -> None:
    posterior, params = small()
    with pytest.raises(InputError, match=told) as caught:
        design(posterior, params, **options)
    assert "\n" not in str(caught.value)


def test_impossible_plans_are_refused() -> None:
    posterior, params = small()
    with pytest.raises(InputError, match="params: got parameters that the prior excludes"):
        design(posterior, np.where(np.arange(params.size) == params.size - 1, -1.0, params))
    with pytest.raises(InputError, match="fold a source's image"):
        design(posterior, np.where(np.arange(params.size) == 2, -5.0, params))
    dark = np.where(np.arange(params.size) == params.size - 1, 0.0, params)
    with pytest.raises(InputError, match="give the frame a background"):
        design(posterior, dark)
    hidden = replace(posterior, mask=np.arange(65)[:, None] + np.zeros(65) > 63)
    with pytest.raises(InputError, match="catalogue: got no source"):
        design(replace(hidden, valid=hidden.mask), params)
    with pytest.raises(InputError, match="params: got shape"):
        design(posterior, params[:-1])
    linear, params = small(distortion=bf.PolynomialDistortion.polynomial(1))
    with pytest.raises(InputError, match="linear terms, which belong to each frame's pose"):
        design(linear, params, dithers=[(0.0, 0.0)])


def test_flat_priors_and_a_single_source() -> None:
    """A flat prior has no curvature: a choice of few sources has a large error, not none."""
    posterior, params = small()
    names = posterior.model.distortion.names
    flat = {name: stats.uniform(-1.0, 2.0) for name in names}
    plan = design(replace(posterior, prior={**posterior.prior, **flat}), params)
    assert np.isfinite(plan.sources.rms).all() and plan.sources.rms[0] > 1e3 * plan.sources.rms[-1]
    one = bf.ForwardModel(
        bf.Detector((65, 65)), bf.SourceCatalog([20.0], [10.0], [1e4]), bf.GaussianPSF(2.0),
        bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]),
    )  # fmt: skip
    alone = design(bf.Posterior(one, one.expected_counts([0.0, 0.0], 2.0)), [0.0, 0.0, 2.0])
    assert alone.sources.order.tolist() == [0]
    assert png(design_plot(alone))[1:4] == b"PNG"


@pytest.mark.slow
def test_footprints_and_scatter() -> None:
    """Footprints follow the images, and positions that scatter make sources tell less."""
    posterior, params = small(nuisances=bf.Nuisances(footprint=8.0))
    plan = design(posterior, params)
    everywhere, _ = small()
    assert plan.error_rms == pytest.approx(design(everywhere, params).error_rms, rel=0.02)
    scattered = bf.Nuisances(flux="free", position_scatter=True)
    posterior, params = small(nuisances=scattered)
    params[posterior.parameter_names.index("position_scatter")] = 0.05
    assert design(posterior, params).error_rms > 1.5 * plan.error_rms


@pytest.mark.parametrize("dithers", [[], [(0.0, 0.0), (8.0, 0.0), (0.0, 8.0)]])
def test_the_figure_has_a_panel_for_each_question(dithers: list[tuple[float, float]]) -> None:
    posterior, params = small()
    fig = design_plot(design(posterior, params, error=2e-3, sources=4, dithers=dithers))
    panels = [ax for ax in fig.axes if ax.get_label() != "<colorbar>"]
    assert len(panels) == (5 if dithers else 3)
    assert all(ax.get_xlabel() and ax.get_ylabel() for ax in panels)
    assert png(fig)[1:4] == b"PNG"

"""Dithered frames without a catalogue: the density, what is not seen, the fit and its errors."""

import pickle
import resource
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import h5py
import numpy as np
import pytest
from scipy import integrate, spatial, stats

import bayesfred as bf
from bayesfred._typing import Floats
from bayesfred.analysis.verify import verify
from bayesfred.calibration.degeneracies import lost_directions
from bayesfred.calibration.dither_tables import newton_misses
from bayesfred.calibration.self_calibration import SelfCalibration, self_calibrate
from bayesfred.errors import InputError
from bayesfred.io.serialize import read, write
from bayesfred.model.dither_layout import rotation
from bayesfred.model.dithered import DitheredPosterior
from bayesfred.model.movable import MovableLikelihood
from bayesfred.optimize.dithers import link_peaks, shifts_between
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.laplace import check_approximation

FREE = bf.Nuisances(flux="free")
LENS = bf.PolynomialDistortion.polynomial(3)
CROSS = np.array([(0.0, 0.0), (14.0, 4.0), (-11.0, 13.0), (5.0, -15.0)])
LINE = np.array([(0.0, 0.0), (14.0, 0.0), (-11.0, 0.0), (5.0, 0.0)])
TURNS = np.array([0.0, 20.0, -15.0, 35.0])


@dataclass
class Field:
    """A simulated field with its truth."""

    counts: dict[str, Floats]
    sky: Floats
    flux: Floats
    theta: Floats
    shifts: Floats
    turns: Floats
    detector: bf.Detector
    psf: bf.GaussianPSF

    def calibrate(self, **given) -> SelfCalibration:
        return self_calibrate(self.counts, self.detector, self.psf, LENS, **given)

    def posterior(self, *, turned: bool = False, **given) -> DitheredPosterior:
        """The posterior of the sources in the frames, as if they had been found."""
        half = 0.5 * np.array(self.detector.shape[::-1])
        frames, members, poses = {}, {}, {}
        for name, at in zip(self.counts, self.places(), strict=True):
            members[name] = np.flatnonzero((np.abs(at) < half - 3.0).all(axis=1))
        seen = np.bincount(np.concatenate(list(members.values())), minlength=len(self.sky)) > 1
        number = np.cumsum(seen) - 1
        for k, (name, at) in enumerate(zip(self.counts, self.places(), strict=True)):
            rows = members[name][seen[members[name]]]
            catalog = bf.SourceCatalog(*at[rows].T, self.flux[rows])
            model = bf.ForwardModel(self.detector, catalog, self.psf, LENS)
            frames[name] = bf.Posterior(model, self.counts[name], nuisances=FREE)
            members[name] = number[rows]
            poses[name] = (*self.shifts[k], self.turns[k])
        return DitheredPosterior(frames, members, poses, turned=turned, **given)

    def places(self) -> list[Floats]:
        pairs = zip(self.shifts, self.turns, strict=True)
        return [self.sky @ rotation(turn).T + shift for shift, turn in pairs]


def coefficients(half: float, size: float) -> Floats:
    """Cubic distortion that moves a source at `half` by `size`, and some quadratic terms."""
    theta = np.zeros(LENS.n_terms)
    cubic, square = -size / half**3, size / half**2
    for name, value in {
        "f_x3": cubic, "f_xy2": cubic, "g_x2y": cubic, "g_y3": cubic,
        "f_x2": 0.2 * square, "g_xy": 0.15 * square, "f_y2": 0.1 * square, "g_y2": -0.1 * square,
    }.items():  # fmt: skip
        theta[LENS.names.index(name)] = value
    return theta


def simulated(
    shifts: Floats = CROSS,
    turns: Floats | None = None,
    *,
    side: int = 100,
    spacing: float = 18.0,
    seed: int = 1,
    size: float = 2.0,
    light: float = 1.0,
) -> Field:
    """Frames of stars on a jittered grid, which leaves them apart."""
    rng = np.random.default_rng(seed)
    turns = np.zeros(len(shifts)) if turns is None else turns
    reach = 0.5 * side * (1.42 if turns.any() else 1.0) + np.abs(shifts).max()
    axis = np.arange(-reach, reach + 1.0, spacing)
    sky = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    sky = sky + rng.uniform(-0.25, 0.25, sky.shape) * spacing
    flux = light * np.exp(rng.uniform(np.log(3e3), np.log(2e4), len(sky)))
    detector, psf = bf.Detector((side, side)), bf.GaussianPSF(1.5)
    field = Field({}, sky, flux, coefficients(0.5 * side, size), shifts, turns, detector, psf)
    for k, at in enumerate(field.places()):
        model = bf.ForwardModel(detector, bf.SourceCatalog(*at.T, flux), psf, LENS)
        frame = bf.simulate(model, field.theta, 8.0, seed=np.random.SeedSequence([seed, k]))
        field.counts["abcdefghi"[k]] = frame
    return field


@pytest.fixture(scope="module")
def field() -> Field:
    return simulated()


@pytest.fixture(scope="module")
def found(field) -> SelfCalibration:
    return field.calibrate()


def truth_of(found: SelfCalibration, field: Field) -> tuple[Floats, Floats]:
    """True positions of the found sources, and their distances from them."""
    distance, index = spatial.cKDTree(field.sky).query(found.posterior.layout.positions(
        found.estimate.params))  # fmt: skip
    return field.sky[index], distance


# --- the density ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small() -> tuple[DitheredPosterior, Floats]:
    """Frames with everything free, of a model that leaves no pixel out, and a point off its top."""
    rng = np.random.default_rng(5)
    sky, flux = rng.uniform(-24.0, 24.0, (9, 2)), rng.uniform(2e3, 6e3, 9)
    sky[1] = sky[0] + [4.0, 1.0]  # a blend
    lens = bf.PolynomialDistortion(
        [(1, 0, 0, 0), (0, 1, 0, 0), (1, 1, 1, 0)], [(0, 1, 0, 0), (0, 2, 1, 0)]
    )
    theta, psf = np.array([0.01, -0.02, 2e-5, 0.015, -3e-5]), bf.GaussianPSF(1.6)
    nuisances = bf.Nuisances(flux="free", psf_sigma=True, background_order=1)
    frames, members, poses = {}, {}, {}
    for k, (shift, turn) in enumerate([((0.0, 0.0), 0.0), ((5.0, -3.0), 10.0), ((-4.0, 4.0), 0.0)]):
        at = sky @ rotation(turn).T + shift
        rows = np.flatnonzero((np.abs(at) < 26.0).all(axis=1))
        model = bf.ForwardModel(
            bf.Detector((51, 51)), bf.SourceCatalog(*at[rows].T, flux[rows]), psf, lens,
            tolerance=0.0,
        )  # fmt: skip
        counts = bf.simulate(model, theta, 4.0, seed=k)
        name = "abc"[k]
        frames[name] = bf.Posterior(model, counts, nuisances=nuisances)
        members[name], poses[name] = rows, (*shift, turn)
    posterior = DitheredPosterior(
        frames, members, poses, pointing_sd=0.3, turned=True, fixed={"f_y": -0.02}
    )
    params = posterior.start()
    params[:4] = np.delete(theta, 1)
    return posterior, params + 0.01 * rng.standard_normal(params.size) * (np.abs(params) > 0.1)


def test_gradient_is_that_of_the_density(small) -> None:
    """Central differences of log_prob, parameter by parameter; steps of 1e-3 sd."""
    posterior, params = small
    step = 1e-3 / np.sqrt(np.diag(posterior.information(params)))
    both = params + np.concatenate([np.diag(step), -np.diag(step)])
    up, down = posterior.log_prob(both).reshape(2, -1)
    slope = (up - down) / 2e-3  # by standard deviations
    gradient = posterior.gradient(params) * 1e3 * step
    assert np.abs(gradient).max() > 3.0
    np.testing.assert_allclose(gradient, slope, rtol=0.0, atol=2e-5)


def test_likelihood_with_moved_sources_is_that_of_a_new_frame(small) -> None:
    posterior, params = small
    for name, frame in posterior.frames.items():
        at = posterior.layout.frame_positions(name, params)
        own = posterior.layout.frame_params(name, params)
        movable = MovableLikelihood.of(frame.likelihood)
        moved = movable.moved(at).log_likelihood(own[None], np.ones(1, bool))[0]
        fresh = posterior.frame_posterior(name, params)
        assert np.array_equal(fresh.model.sources.x, at[:, 0])
        assert moved == pytest.approx(
            float(fresh.log_prob(own) - fresh.log_prior(own)[0]), abs=1e-8
        )
        first = movable.log_likelihood(own[None], np.ones(1, bool))[0]
        assert abs(moved - first) > 1e-3  # they did move
        # both search for the fluxes themselves: neither has evaluated log_prob
        again = posterior.frame_posterior(name, params).likelihood
        np.testing.assert_allclose(
            movable.moved(at).gradients(own)[0], again.gradient(own), rtol=1e-9
        )


@pytest.mark.parametrize("method", ["gradient", "fisher", "information", "prior_information"])
def test_several_vectors_are_refused_where_one_is_answered(small, method: str) -> None:
    posterior, params = small
    several = np.stack([params, params])
    assert posterior.log_prior(several).shape == (2,)
    with pytest.raises(InputError, match="expected one vector of shape"):
        getattr(posterior, method)(several)


def test_log_prob_is_a_sum_over_frames_and_priors(small) -> None:
    posterior, params = small
    total = float(posterior.log_prior(params)[0])
    for name in posterior.frames:
        frame, own = (
            posterior.frame_posterior(name, params),
            posterior.layout.frame_params(name, params),
        )
        total += float(frame.log_prob(own) - frame.log_prior(own)[0])
    assert posterior.log_prob(params) == pytest.approx(total, abs=1e-7)
    outside = params.copy()
    outside[posterior.parameter_names.index("a.background")] = -1.0
    assert posterior.log_prob(np.stack([params, outside])).tolist() == [
        posterior.log_prob(params),
        -np.inf,
    ]
    assert np.isnan(posterior.gradient(outside)).all()


def test_information_is_minus_the_mean_hessian(small) -> None:
    """Of frames that are their own expectation the Hessian is the information.

    But for what terms in u and v change in the shapes of images, some per cent here.
    """
    posterior, params = small
    frames = {}
    for name in posterior.frames:
        frame, own = (
            posterior.frame_posterior(name, params),
            posterior.layout.frame_params(name, params),
        )
        model = frame.model
        flux = frame.fluxes(own)
        known = bf.SourceCatalog(model.sources.x, model.sources.y, flux)
        exact = bf.ForwardModel(model.detector, known, model.psf, model.distortion)
        counts = bf.Posterior(exact, frame.counts, nuisances=bf.Nuisances(
            psf_sigma=True, background_order=1)).expected_counts(own)  # fmt: skip
        frames[name] = bf.Posterior(exact, counts, nuisances=frame.nuisances)
    expected = DitheredPosterior(
        frames, posterior.members, posterior.pointings, pointing_sd=0.3, turned=True,
        fixed=posterior.fixed,
    )  # fmt: skip
    information = expected.information(params)
    sd = 1.0 / np.sqrt(np.diag(information))
    rows = [
        (expected.gradient(params - e) - expected.gradient(params + e)) / 0.02 * sd
        for e in np.diag(0.01 * sd)
    ]
    np.testing.assert_allclose(np.array(rows), information * np.outer(sd, sd), rtol=0.0, atol=0.04)


def test_prior_of_pointings_has_no_common_shift(small) -> None:
    """It is the integral of independent normals over the shift, up to a constant."""
    posterior, params = small
    given = np.array(list(posterior.pointings.values()))
    places = [[posterior.parameter_names.index(f"{n}.pointing_{a}") for a in "xy"] for n in "bc"]

    def density(off: Floats) -> float:
        """Normals of d_i + R_i c, integrated over c."""
        d = np.vstack([[0.0, 0.0], off])

        def integrand(y: float, x: float) -> float:
            shifted = d + [rotation(turn) @ [x, y] for turn in given[:, 2]]
            return float(np.exp(-0.5 * np.sum(shifted**2) / 0.3**2))

        return integrate.dblquad(integrand, -2.0, 2.0, -2.0, 2.0)[0]

    values, wanted = [], []
    for off in (
        np.zeros((2, 2)),
        np.array([[0.2, -0.1], [0.3, 0.25]]),
        np.array([[0.3, 0.0], [0.0, 0.3]]),
    ):
        there = params.copy()
        there[places] = given[1:, :2] + off
        values.append(float(posterior.log_prior(there)[0]))
        wanted.append(np.log(density(off)))
    np.testing.assert_allclose(np.diff(values), np.diff(wanted), atol=1e-6)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"nuisances": bf.Nuisances()}, "a: nuisances: got flux = 'fixed'"),
        ({"nuisances": bf.Nuisances(flux="free", offset=True)}, "offset = True"),
        ({"members": {"a": [0]}}, "members: a: got"),
        ({"pointings": {"a": (0.0, 0.0)}}, "pointings: a: got"),
        ({"fixed": {"f_z": 0.0}}, "fixed: got f_z"),
        ({"prior": {"b.background": stats.norm(0, 1)}}, "prior: got b.background"),
    ],
)
def test_unusable_frames_are_refused(change: Mapping[str, object], line: str) -> None:
    model = bf.ForwardModel(
        bf.Detector((33, 33)), bf.SourceCatalog([0.0, 9.0], [0.0, 5.0], [1e3, 1e3]),
        bf.GaussianPSF(1.5), LENS,
    )  # fmt: skip
    given = {"members": {"a": [0, 1]}, "pointings": {"a": (0.0, 0.0, 0.0)}} | dict(change)
    frame = bf.Posterior(model, np.ones((33, 33)), nuisances=given.pop("nuisances", FREE))
    with pytest.raises(InputError, match=line):
        DitheredPosterior({"a": frame}, given.pop("members"), given.pop("pointings"), **given)


# --- what is not seen -----------------------------------------------------------------------------


def linear_maps(field: Field, matrices: Sequence[Floats]) -> Floats:
    """Changes of the coefficients by h = 1 + E, (1 - D f) E x, as polynomials of degree 3."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.0, 1.0, (2, 60)) * 50.0
    step = 1e-3
    slopes = [
        (np.array(LENS.displacement(field.theta, 0.0, 0.0, x + dx, y + dy))
         - np.array(LENS.displacement(field.theta, 0.0, 0.0, x - dx, y - dy))) / (2.0 * step)
        for dx, dy in ((step, 0.0), (0.0, step))
    ]  # fmt: skip
    design = LENS.design_matrix(x, y, x, y).reshape(-1, LENS.n_terms)
    scale = np.abs(design).max(axis=0)
    out = []
    for matrix in matrices:
        moved = np.array(matrix) @ np.stack([x, y])
        wanted = moved - slopes[0] * moved[0] - slopes[1] * moved[1]
        solved, *_ = np.linalg.lstsq(design / scale, wanted.ravel(), rcond=None)
        np.testing.assert_allclose(design / scale @ solved, wanted.ravel(), atol=1e-6)
        out.append(solved / scale)
    return np.array(out)


def same_span(one: Floats, other: Floats) -> bool:
    """Whether the rows of two matrices span the same space."""
    if one.shape[0] != other.shape[0]:
        return False
    p, q = (np.linalg.qr(m.T).Q for m in (one, other))
    return bool(np.linalg.svd(p.T @ q, compute_uv=False).min() > 1.0 - 1e-6)


SCALE, ROTATION = [[1.0, 0.0], [0.0, 1.0]], [[0.0, -1.0], [1.0, 0.0]]
ALL_MAPS = [SCALE, ROTATION, [[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]]


def at_truth(field: Field, posterior: DitheredPosterior) -> Floats:
    params = posterior.start()
    theta = posterior.layout.parts[0].theta
    params[: theta.size] = field.theta[theta]
    return params


@pytest.mark.parametrize(
    ("shifts", "turns", "given", "maps"),
    [
        (CROSS, None, {}, ALL_MAPS),
        (CROSS, TURNS, {"turned": True}, [SCALE, ROTATION]),
        (CROSS, 180.0 * np.arange(4), {"turned": True}, ALL_MAPS),
        (CROSS, None, {"pointing_sd": 0.05}, []),
        (LINE, None, {}, ALL_MAPS),
        (LINE, None, {"pointing_sd": 0.05}, [[[0.0, 1.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]]),
    ],
    ids=["shifts", "turned", "upside down", "known", "line", "known line"],
)
def test_lost_directions_are_those_of_the_theory(shifts, turns, given, maps) -> None:
    field = simulated(shifts, turns)
    posterior = field.posterior(**given)
    unseen, poor = lost_directions(posterior, at_truth(field, posterior))
    on_line = shifts is LINE
    assert (poor is not None) == on_line
    if on_line:  # functions of y, which distortion shows a little
        assert {"f_y3", "g_y3", "f_y2", "g_y2"} & set(poor.parameters)
        assert not poor.fixed and "dithers in two directions" in poor.remedy
    if not maps:
        assert unseen is None
        return
    scale = np.abs(LENS.design_matrix(50.0, 50.0, 50.0, 50.0)).max(axis=0)
    predicted = linear_maps(field, maps) * scale
    assert same_span(unseen.directions * scale, predicted)
    assert len(unseen.parameters) == len(maps)
    assert set(unseen.parameters) <= {"f_x", "f_y", "g_x", "g_y"}
    # another direction is not among them
    wrong = predicted.copy()
    wrong[0, LENS.names.index("f_x3")] += 0.1 * np.abs(wrong[0]).max()
    assert not same_span(unseen.directions * scale, wrong)


def test_linear_maps_leave_the_frames_as_they_are(field) -> None:
    """Not to first order alone: P h^-1, A X and A t have the likelihood of P, X and t."""
    posterior = field.posterior()
    params, layout = at_truth(field, posterior), posterior.layout
    matrix = np.array([[1.02, -0.015], [0.01, 0.97]])
    inverse = np.linalg.inv(matrix)
    rng = np.random.default_rng(1)
    x = rng.uniform(-50.0, 50.0, (60, 2))
    back = x @ inverse.T
    f, g = LENS.displacement(field.theta, 0.0, 0.0, *back.T)
    wanted = x - (back - np.stack([f, g], axis=1))  # x - P(h^-1 x)
    design = LENS.design_matrix(*x.T, *x.T).reshape(-1, LENS.n_terms)
    scale = np.abs(design).max(axis=0)
    theta = np.linalg.lstsq(design / scale, wanted.T.ravel(), rcond=None)[0] / scale
    moved = params.copy()
    moved[: theta.size] = theta
    for part in layout.parts[1:]:
        moved[part.pointing[:2]] = matrix @ params[part.pointing[:2]]
    moved[layout.n_dense :] = (layout.positions(params) @ matrix.T).ravel()

    def likelihood(vector: Floats) -> float:
        return float(posterior.log_prob(vector) - posterior.log_prior(vector)[0])

    assert likelihood(moved) == pytest.approx(likelihood(params), abs=1e-3)
    moved[: theta.size] = field.theta  # positions and pointings alone
    assert likelihood(moved) < likelihood(params) - 1e4


# --- where to begin -------------------------------------------------------------------------------


def test_shifts_are_found_from_peaks_alone() -> None:
    rng = np.random.default_rng(3)
    sky = rng.uniform(-80.0, 80.0, (60, 2))
    shifts = np.array([(0.0, 0.0), (25.0, -9.0), (-14.0, 30.0)])
    turns = np.array([0.0, 90.0, 0.0])
    peaks = [
        rng.permutation(sky @ rotation(turn).T + shift + rng.normal(0.0, 0.3, sky.shape))[:50]
        for shift, turn in zip(shifts, turns, strict=True)
    ]
    found = shifts_between(peaks, turns, 1.5, ["a", "b", "c"])
    np.testing.assert_allclose(found, shifts, atol=0.5)
    peaks[2] = rng.uniform(-80.0, 80.0, (50, 2))
    with pytest.raises(InputError, match="frames: c: got peaks that agree"):
        shifts_between(peaks, turns, 1.5, ["a", "b", "c"])


def test_links_grow_over_a_distortion_as_large_as_the_stars_distances() -> None:
    rng = np.random.default_rng(4)
    theta, half = coefficients(250.0, 40.0), 250.0
    sky = rng.uniform(-300.0, 300.0, (300, 2))
    shifts = 2.0 * CROSS
    peaks = {}
    for name, shift in zip("abcd", shifts, strict=True):
        u, v = LENS.image_position(theta, *(sky + shift).T)
        inside = (np.abs(u) < half) & (np.abs(v) < half)
        peaks[name] = np.stack([u, v], axis=1)[inside] + rng.normal(0.0, 0.1, (inside.sum(), 2))
    f, g = LENS.largest_displacement(half, half)
    poses = np.column_stack([shifts + rng.normal(0.0, 2.0, shifts.shape), np.zeros(4)])
    poses[0] = 0.0
    fixed = dict.fromkeys(("f_x", "f_y", "g_x", "g_y"), 0.0)
    links = link_peaks(
        peaks, LENS, poses, 1.5, farthest=12.0, sd=0.1 * half / np.maximum(f, g), fixed=fixed
    )
    assert sum(int((s >= 0).sum()) for s in links.source) > 0.95 * sum(map(len, peaks.values()))
    np.testing.assert_allclose(links.pointings[:, :2], shifts, atol=0.1)
    off = LENS.largest_displacement(half, half) * (links.theta - theta)
    assert np.abs(off).max() < 0.5


# --- the fit --------------------------------------------------------------------------------------


def test_fit_finds_distortion_pointings_and_positions(field, found) -> None:
    assert found.trustworthy and found.not_normal < 0.05
    table = found.parameters
    assert list(table["name"][table["status"] == "fixed"]) == ["f_x", "f_y", "g_x", "g_y"]
    free = found.posterior.layout.parts[0].theta
    off = found.estimate.params[: free.size] - field.theta[free]
    covariance = found.estimate.covariance[: free.size, : free.size]
    assert stats.chi2.sf(off @ np.linalg.solve(covariance, off), free.size) > 1e-4
    z = np.array(found.frames["pointing_x"])[1:] - field.shifts[1:, 0]
    assert np.abs(z / np.array(found.frames["pointing_x_sd"])[1:]).max() < 4.5
    true, distance = truth_of(found, field)
    assert distance.max() < 0.2 and len(found.catalogue) > 25
    off = np.stack([found.catalogue.x, found.catalogue.y], axis=1) - true
    chi2 = np.einsum("si,sij,sj->s", off, np.linalg.inv(found.positions_covariance), off)
    assert np.mean(chi2 < stats.chi2.ppf(0.68, 2)) > 0.4 and chi2.max() < 30.0
    sd = np.stack([found.sources["x_sd"], found.sources["y_sd"]], axis=1) ** 2
    np.testing.assert_allclose(np.einsum("sii->si", found.positions_covariance), sd)
    ratio = found.catalogue.flux / field.flux[spatial.cKDTree(field.sky).query(true)[1]]
    assert np.abs(ratio - 1.0).max() < 0.1


def test_message_says_misfit_then_degeneracies_then_errors(found) -> None:
    text = found.message
    order = ["All 4 frames fit", "Not seen by these frames", "a.pointing_x",
             "scale, rotation and shear of the field (f_x, f_y, g_x, g_y)", "pointing_sd",
             "positions known to", "The posterior is normal"]  # fmt: skip
    places = [text.index(each) for each in order]
    assert places == sorted(places)


def test_catalogue_serves_in_another_frame(field, found) -> None:
    """A fifth exposure, so faint that its own errors dominate, agrees in the same convention."""
    model = bf.ForwardModel(
        field.detector, bf.SourceCatalog(*field.sky.T, field.flux / 20.0), field.psf, LENS
    )
    counts = bf.simulate(model, field.theta, 2.0, seed=77)
    stars = found.catalogue
    near = (np.abs(np.stack([stars.x, stars.y])) < 56.0).all(axis=0)
    known = bf.SourceCatalog(stars.x[near], stars.y[near], stars.flux[near] / 20.0)
    lens = bf.ForwardModel(field.detector, known, field.psf, LENS)
    nuisances = bf.Nuisances(flux="free", footprint=6.0)
    posterior = bf.Posterior(lens, counts, nuisances=nuisances)
    estimate = bf.find_map(posterior)
    n = LENS.n_terms
    layout = found.posterior.layout
    free, own = layout.parts[0].theta, np.zeros((n, n))
    own[np.ix_(free, free)] = found.estimate.covariance[: free.size, : free.size]
    off = estimate.params[:n] - layout.theta(found.estimate.params)
    total = estimate.covariance[:n, :n] + own
    scale = 1.0 / np.sqrt(np.diag(total))
    whitened = np.linalg.solve(np.linalg.cholesky(total * np.outer(scale, scale)), off * scale)
    assert stats.chi2.sf(whitened @ whitened, n) > 1e-3
    # without a distortion it would not
    off = estimate.params[:n]
    whitened = np.linalg.solve(np.linalg.cholesky(total * np.outer(scale, scale)), off * scale)
    assert stats.chi2.sf(whitened @ whitened, n) < 1e-6


def test_calibration_maps_the_field_within_its_errors(field, found, tmp_path) -> None:
    calibration = found.calibration(title="lens")
    path = tmp_path / "lens.h5"
    calibration.write(path)
    again = bf.Calibration.read(path)
    assert again.trustworthy and again.message == found.message
    u, v = (p.ravel() for p in np.meshgrid(np.linspace(-35, 35, 5), np.linspace(-35, 35, 5)))
    x, y, covariance = again.to_object(u, v)
    true = LENS.object_position(field.theta, u, v)
    off = np.stack([x - true[0], y - true[1]], axis=1)
    sd = np.sqrt(np.einsum("kii->ki", covariance))
    assert np.all(np.abs(off) < 5.0 * sd + 1e-9)
    assert 0.0 < sd.max() < 0.05


def test_laplace_and_find_map_run_on_the_posterior(found, tmp_path) -> None:
    again = bf.find_map(found.posterior, found.estimate.params)
    assert again.at_maximum and np.allclose(again.params, found.estimate.params)
    path = tmp_path / "dithers.h5"
    chain = bf.laplace(found.posterior, found.estimate, seed=1, draws=64, path=path, progress=False)
    assert chain.draws().shape == (64, found.posterior.n_parameters)
    assert check_approximation(chain).efficiency > 0.5
    stored = open_chain(path)
    assert np.array_equal(stored.chain, chain.chain)
    rebuilt, draws = stored.posterior(), chain.draws()[:4]
    assert rebuilt.log_prob(draws).tobytes() == found.posterior.log_prob(draws).tobytes()
    assert all(check.holds for check in verify(path))


def test_sampler_agrees_with_the_laplace_approximation() -> None:
    """Seven sources in three frames: means and widths of 400 effective draws, sd 0.05 and 0.035."""
    sky = np.random.default_rng(1).uniform(-22.0, 22.0, (7, 2))
    lens = bf.PolynomialDistortion([(3, 0, 0, 0)], [(0, 3, 0, 0)])
    frames, poses = {}, {"a": (0.0, 0.0, 0.0), "b": (9.0, -3.0, 0.0), "c": (-4.0, 8.0, 0.0)}
    for k, (name, (x, y, _)) in enumerate(poses.items()):
        catalog = bf.SourceCatalog(sky[:, 0] + x, sky[:, 1] + y, np.full(7, 5e3))
        model = bf.ForwardModel(bf.Detector((61, 61)), catalog, bf.GaussianPSF(2.0), lens)
        counts = bf.simulate(model, [1e-5, 1e-5], 2.0, seed=k)
        frames[name] = bf.Posterior(model, counts, nuisances=FREE)
    posterior = DitheredPosterior(frames, {name: np.arange(7) for name in frames}, poses)
    top = bf.find_map(posterior, posterior.start())
    draws = bf.sample(posterior, top, seed=1, target_ess=400, ensembles=2, progress=False).draws()
    sd = np.sqrt(np.diag(top.covariance))
    assert np.abs((draws.mean(axis=0) - top.params) / sd).max() < 0.25
    assert np.abs(draws.std(axis=0) / sd - 1.0).max() < 0.2


def test_posterior_survives_a_file_and_pickling(found, tmp_path) -> None:
    with h5py.File(tmp_path / "posterior.h5", "w") as file:
        write(file.create_group("posterior"), found.posterior)
        stored = read(file["posterior"], DitheredPosterior)
    for again in (stored, pickle.loads(pickle.dumps(found.posterior))):
        assert again.parameter_names == found.posterior.parameter_names
        assert again.log_prob(found.estimate.params) == pytest.approx(
            found.estimate.log_prob, abs=1e-6
        )


def test_known_pointings_tell_the_scale(field, found) -> None:
    """The error of the scale is that of the pointings over their spread."""
    given = {name: tuple(t) for name, t in zip(field.counts, field.shifts, strict=True)}
    known = field.calibrate(pointings=given, pointing_sd=0.05)
    assert len(known.degeneracies) == 1
    table = known.parameters
    assert set(table["status"]) == {"measured"}
    sd = dict(zip(table["name"], table["sd"], strict=True))
    centred = field.shifts - field.shifts.mean(axis=0)
    spread = np.linalg.inv(centred.T @ centred)
    assert sd["f_x"] == pytest.approx(0.05 * np.sqrt(spread[0, 0]), rel=0.05)
    assert sd["g_y"] == pytest.approx(0.05 * np.sqrt(spread[1, 1]), rel=0.05)
    z = (table["value"] - field.theta) / table["sd"]
    assert np.abs(z).max() < 4.5
    # the shape of the field is known as well as without them
    cubic = LENS.names.index("f_x3")
    assert known.parameters["sd"][cubic] < 3.0 * found.parameters["sd"][cubic]


def test_turned_frames_tell_shears() -> None:
    field = simulated(CROSS, TURNS)
    turns = dict(zip(field.counts, TURNS + np.array([0.0, 0.5, -0.5, 0.5]), strict=True))
    found = field.calibrate(turns=turns)
    assert found.trustworthy
    assert [len(each.parameters) for each in found.degeneracies] == [3, 2]
    z = (np.array(found.frames["turn"]) - TURNS)[1:] / np.array(found.frames["turn_sd"])[1:]
    assert np.abs(z).max() < 4.5


def test_dithers_on_a_line_are_not_called_measured() -> None:
    found = simulated(LINE).calibrate()
    assert not found.trustworthy
    status = dict(zip(found.parameters["name"], found.parameters["status"], strict=True))
    assert "prior" in status.values()
    assert np.isnan(
        np.array(found.parameters["sd"])[np.array(found.parameters["status"]) == "prior"]
    ).all()
    assert "Hardly seen, left to the priors" in found.message
    assert "not normal" in found.message


def test_blends_movers_and_foreign_light_are_left_out(field) -> None:
    counts = {name: frame.copy() for name, frame in field.counts.items()}
    rng = np.random.default_rng(8)
    order = np.argsort(np.hypot(*field.sky.T))
    blend, mover = order[2], order[5]
    for k, (name, at) in enumerate(zip(field.counts, field.places(), strict=True)):
        extra = np.array([at[blend] + [2.6, 1.0], at[mover] + [0.0, 0.0]])
        model = bf.ForwardModel(
            field.detector, bf.SourceCatalog(*extra.T, [9e3, 9e3]), field.psf, LENS
        )
        before = model.expected_counts(field.theta)
        moved = bf.SourceCatalog(*(extra + np.array([[0.0, 0.0], [0.4 * k, 0.0]])).T, [9e3, 9e3])
        after = bf.ForwardModel(field.detector, moved, field.psf, LENS).expected_counts(field.theta)
        own = bf.SourceCatalog(*at[[mover]].T, field.flux[[mover]])
        gone = bf.ForwardModel(field.detector, own, field.psf, LENS).expected_counts(field.theta)
        assert before.sum() > 0.0
        counts[name] = np.maximum(counts[name] - np.round(gone), 0.0) + rng.poisson(after)
        counts[name][20 + 9 * k : 22 + 9 * k, 70:72] += 800.0  # a cosmic ray
    found = self_calibrate(counts, field.detector, field.psf, LENS)
    assert found.trustworthy
    distance, _ = spatial.cKDTree(field.sky[[blend, mover]]).query(found.rejected)
    assert 1 <= len(found.rejected) <= 5 and distance.min() < 3.0
    free = found.posterior.layout.parts[0].theta
    off = found.estimate.params[: free.size] - field.theta[free]
    covariance = found.estimate.covariance[: free.size, : free.size]
    assert stats.chi2.sf(off @ np.linalg.solve(covariance, off), free.size) > 1e-4


def test_wrong_psf_is_said_and_not_masked_away(field) -> None:
    counts = {name: field.counts[name] for name in "abc"}
    found = self_calibrate(counts, field.detector, bf.GaussianPSF(1.65), LENS)
    assert not found.trustworthy and not found.fits_data
    assert "do not fit" in found.message or "sources do not" in found.message
    free = bf.Nuisances(flux="free", psf_sigma=True)
    found = self_calibrate(counts, field.detector, bf.GaussianPSF(1.65), LENS, nuisances=free)
    assert found.trustworthy
    width = found.estimate.params[found.posterior.parameter_names.index("b.psf_sigma")]
    assert width == pytest.approx(1.5, abs=0.02)


def test_newton_misses_see_a_wrong_width_and_a_wrong_place(found) -> None:
    params, covariance = found.estimate.params, found.estimate.covariance
    right = newton_misses(found.posterior, params, covariance)
    assert right[0] < 0.05 and right[1].max() < 0.2
    wide = newton_misses(found.posterior, params, 1.5 * covariance)
    assert wide[0] > 0.4 and wide[1].min() > 0.3  # by half of the variance
    z = np.random.default_rng(3).standard_normal(params.size)
    beside = params + 0.5 * np.linalg.cholesky(covariance) @ z
    assert newton_misses(found.posterior, beside, covariance)[0] > 0.4


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"nuisances": bf.Nuisances()}, "flux: got 'fixed', expected 'free'"),
        ({"pointing_sd": 0.1}, "pointing_sd: got it without pointings"),
        ({"pointings": {"a": (0.0, 0.0)}}, "pointings: b: got None"),
        ({"turns": {"a": 0.0, "b": 0.0, "c": 0.0}}, "turns: d: got None"),
        ({"pointings": dict.fromkeys("abcd", (0.0, 0.0)), "pointing_sd": -1.0}, "pixels > 0"),
        ({"detector": bf.Detector((99, 100))}, "frames: a: got shape"),
        ({"counts": {"a": np.ones((100, 100))}}, "frames: got 1"),
        ({"counts": {"a": np.ones((100, 100)), "b": np.ones((100, 100))}}, "frames: b: got"),
    ],
)
def test_unusable_input_is_one_line(field, given, line) -> None:
    given = dict(given)
    counts, detector = given.pop("counts", field.counts), given.pop("detector", field.detector)
    with pytest.raises(InputError, match=line):
        self_calibrate(counts, detector, field.psf, LENS, **given)


# --- statistics -----------------------------------------------------------------------------------


@pytest.mark.statistics
def test_coverage_of_coefficients_and_positions() -> None:
    """68 % of coefficients, displacements and positions; not so if others are taken for exact."""
    sets, inside = 100, []
    for seed in range(sets):
        field = simulated(seed=100 + seed)
        found = field.calibrate()
        layout, params = found.posterior.layout, found.estimate.params
        free, d = layout.parts[0].theta, layout.n_dense
        covariance, known = found.estimate.covariance, found.posterior.information(params)
        true, distance = truth_of(found, field)
        assert distance.max() < 0.3
        off_theta = params[: free.size] - field.theta[free]
        off_at = (layout.positions(params) - true).ravel()
        alone = np.linalg.inv(known[:d, :d])[: free.size, : free.size]
        alone_at = np.linalg.inv(known[d:, d:])
        inside.append(
            [
                np.mean(np.abs(off) < np.sqrt(np.diag(c)))
                for off, c in (
                    (off_theta, covariance[: free.size, : free.size]),
                    (off_at, covariance[d:, d:]),
                    (off_theta, alone),  # of positions that are exact
                    (off_at, alone_at),  # of a distortion that is exact
                )
            ]
        )
    mean, error = np.mean(inside, axis=0), np.std(inside, axis=0) / np.sqrt(sets)
    print(mean, error)
    expected = stats.norm.cdf(1.0) - stats.norm.cdf(-1.0)
    assert np.all(np.abs(mean[:2] - expected) < 3.5 * error[:2])
    assert np.all(mean[2:] < expected - 5.0 * error[2:])


@pytest.mark.long
def test_300_sources_and_9_dithers() -> None:
    """Cubic distortion of 10 pixels, dithers of a sixth of the field: time, memory, errors."""
    step = 80.0 * np.array([(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1)])
    shifts = np.roll(step + np.random.default_rng(2).uniform(-8.0, 8.0, step.shape), -4, axis=0)
    field = simulated(shifts - shifts[0], side=512, spacing=28.0, size=10.0)
    before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    found = field.calibrate()
    spent = time.process_time() - started
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(f"{spent:.1f} s of processor time, {grown / 1024:.0f} MiB more", found.message)
    assert found.trustworthy and len(found.catalogue) >= 300 and len(found.frames) == 9
    assert grown < 1024 * 1024  # KiB
    free = found.posterior.layout.parts[0].theta
    off = found.estimate.params[: free.size] - field.theta[free]
    covariance = found.estimate.covariance[: free.size, : free.size]
    assert stats.chi2.sf(off @ np.linalg.solve(covariance, off), free.size) > 1e-4
    true, distance = truth_of(found, field)
    off = np.stack([found.catalogue.x, found.catalogue.y], axis=1) - true
    chi2 = np.einsum("si,sij,sj->s", off, np.linalg.inv(found.positions_covariance), off)
    assert distance.max() < 0.3
    assert 0.55 < np.mean(chi2 < stats.chi2.ppf(0.68, 2)) < 0.80

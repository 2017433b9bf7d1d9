"""PSFs that vary between nodes: their equations against dense ones, and simulated frames."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

import bayesfred as bf
from bayesfred.imaging.psf.spline_values import spline_coefficients
from bayesfred.model.kernels.clusters import DOF
from bayesfred.model.kernels.psf_normal import halved
from bayesfred.optimize import fit_psf
from bayesfred.optimize import measure_psf as measuring
from bayesfred.optimize.fit_psf import _measured_at_nodes
from bayesfred.optimize.psf_equations import PsfEquations, observed
from bayesfred.optimize.psf_marginal import lit_pixels
from bayesfred.optimize.psf_nodes import NodeEquations
from bayesfred.optimize.psf_samples import PsfSamples
from bayesfred.optimize.psf_split import split
from bayesfred.optimize.psf_start import starting_grid, starting_state
from bayesfred.optimize.psf_turns import how_far, solved

SIGMA, SIDE, NODES = 1.4, 285, 5


def turning_psf(half, number=NODES):
    """Ellipses that turn by 45 degrees from node to node: no polynomial of low degree."""
    x = np.arange(-32, 33) / 4.0
    a, b = x, x[:, None]
    round_one = np.exp(-(a**2 + b**2) / (2 * SIGMA**2)) / (2 * np.pi * SIGMA**2)
    terms = [round_one]
    for row in range(number):
        for column in range(number):
            angle = 0.25 * np.pi * (row + column)
            p, q = a * np.cos(angle) + b * np.sin(angle), b * np.cos(angle) - a * np.sin(angle)
            long, short = 1.25 * SIGMA, SIGMA / 1.25
            own = np.exp(-0.5 * (p / long) ** 2 - 0.5 * (q / short) ** 2) / (2 * np.pi * SIGMA**2)
            terms.append(own / own.sum() * round_one.sum() - round_one)
    return bf.MeasuredPSF(
        np.array([spline_coefficients(t) for t in terms]), 4.0, half, nodes=number
    )


def frame_of(seed, side=SIDE, grid=20, flux=3e4, number=NODES, scatter=0.0):
    """A posterior that takes the PSF for a Gaussian, and the true parameters.

    Where positions scatter about the catalogue the posterior knows of it.
    """
    terms = [(1, 0, 0, 0), (0, 1, 0, 0), (2, 0, 0, 0), (1, 1, 0, 0), (0, 2, 0, 0)]
    distortion = bf.PolynomialDistortion(terms, terms)
    detector = bf.Detector((side, side))
    stars = bf.SourceCatalog.grid(grid, 13.6, flux)  # every phase of the pixels
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=10) * np.repeat([[2e-3] * 2 + [1e-5] * 3], 2, axis=0).ravel()
    scale = scatter * np.sqrt(DOF / rng.chisquare(DOF, len(stars)))
    by_x, by_y = scale * rng.normal(size=(2, len(stars)))
    there = replace(stars, x=stars.x + by_x, y=stars.y + by_y)
    true = bf.ForwardModel(detector, there, turning_psf(0.5 * side, number), distortion)
    counts = bf.simulate(true, theta, 20.0, seed=seed)
    taken = bf.ForwardModel(
        bf.Detector((side, side), pixel="box"), stars, bf.GaussianPSF(SIGMA), distortion
    )
    nuisances = bf.Nuisances(
        flux="free", offset=True, psf_sigma=True, position_scatter=scatter > 0.0
    )
    return bf.Posterior(taken, counts, nuisances=nuisances), theta


def began(posterior, estimate):
    grid = starting_grid(posterior, estimate, 4, 0)
    return starting_state(posterior, estimate, grid).with_nodes(2)


def dense(equations):
    """The derivatives of the pixels by the nodes' coefficients, and by what is eliminated."""
    weights, splines = equations.weights.toarray(), equations.splines.toarray()
    sources, knots = weights.shape[0], equations.knots
    each = splines.reshape(-1, sources, knots)
    return np.einsum("psk,sn->pnk", each, weights).reshape(len(each), -1)


def test_equations_agree_with_dense_ones():
    posterior, _ = frame_of(3, side=61, grid=4)
    state = began(posterior, bf.find_map(posterior))
    equations = NodeEquations.of(posterior, state, 0.02)
    design = dense(equations)
    own = (equations.templates @ equations.eliminated).toarray()
    apart = own @ linalg.lstsq(own, np.column_stack([design, equations.residual]))[0]
    design, residual = np.hsplit(np.column_stack([design, equations.residual]) - apart, [-1])
    # the conventions by Lagrange's multipliers
    strength, nodes = 7.0, equations.weights.shape[1]
    matrix = design.T @ design + np.kron(np.eye(nodes), strength * equations.precision)
    rows = np.kron(np.eye(nodes), equations.conventions)
    system = np.block([[matrix, rows.T], [rows, np.zeros((len(rows), len(rows)))]])
    pull = design.T @ residual[:, 0]
    expected = linalg.solve(system, np.append(pull, np.zeros(len(rows))))[: len(pull)]
    pull = pull.reshape(nodes, -1)
    found = equations.solution(strength, pull, np.zeros_like(pull), 1e-9)
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-4 * np.abs(expected).max())
    assert np.abs(equations.conventions @ found.T).max() < 1e-12 * np.abs(found).max()


@pytest.mark.parametrize("scatter", [0.0, 0.05])
def test_slopes_widen_the_errors_as_the_nodes_do(scatter):
    """Against the joint information of nodes, parameters, fluxes and shifts."""
    posterior, _ = frame_of(3, side=61, grid=4)
    nuisances = replace(posterior.nuisances, position_scatter=scatter > 0.0)
    posterior = replace(posterior, nuisances=nuisances)
    state = began(posterior, bf.find_map(posterior))
    names, params = list(posterior.parameter_names), state.params.copy()
    if scatter:
        params[names.index("position_scatter")] = scatter
    state = replace(state, params=params)
    equations = NodeEquations.of(posterior, state, 0.02)
    nodes, strength = equations.weights.shape[1], 7.0
    free = np.kron(np.eye(nodes), linalg.null_space(equations.conventions))
    tied = free.T @ np.kron(np.eye(nodes), strength * equations.precision) @ free
    by_psf, size = dense(equations) @ free, len(state.fluxes)
    each = np.eye(3 * size, equations.templates.shape[1])[:: 1 if scatter else 3]
    own, by = equations.templates @ each.T, equations.templates @ equations.parameters
    known = np.zeros((size, 3))
    known[:, 1:] = scatter and scatter**-2.0
    known = np.diag(known.ravel()[:: 1 if scatter else 3])
    moving = np.abs(by).sum(axis=0) > 0.0
    by = by[:, moving]

    def covariance(others, priors):
        design = np.column_stack([by, others])
        matrix = design.T @ design
        matrix += linalg.block_diag(np.zeros((by.shape[1],) * 2), priors)
        scale = 1.0 / np.sqrt(np.diag(matrix))
        inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
        return inverse[: by.shape[1], : by.shape[1]]

    alone = covariance(own, known)
    more = covariance(np.column_stack([own, by_psf]), linalg.block_diag(known, tied)) - alone
    found = alone @ equations.covariance_of_slopes(strength)[np.ix_(moving, moving)] @ alone
    sd = np.sqrt(np.diag(more))
    # what a solution of 0.3 % is off
    np.testing.assert_allclose(found / np.outer(sd, sd), more / np.outer(sd, sd), atol=0.02)
    assert {"background", "offset_x"} < set(np.array(names)[moving])


def test_shifts_of_single_sources_are_pulled_to_their_prior():
    """Against the joint solution of nodes, parameters, fluxes and shifts."""
    posterior, _ = frame_of(5, side=61, grid=4)
    nuisances = replace(posterior.nuisances, position_scatter=True)
    posterior = replace(posterior, nuisances=nuisances)
    state = began(posterior, bf.find_map(posterior))
    params, sd = state.params.copy(), 0.005  # as much as the counts tell
    params[posterior.parameter_names.index("position_scatter")] = sd
    shifts = np.random.default_rng(2).normal(size=state.shifts.shape) * 3.0 * sd
    state = replace(state, params=params, shifts=shifts)
    equations = NodeEquations.of(posterior, state, 0.02)
    strength, start = 7.0, np.zeros((4, equations.knots))
    found = equations.solution(strength, equations.pull, start, 1e-9).ravel()
    own = (equations.templates @ equations.eliminated).toarray() * np.where(
        np.isfinite(equations.lengths), equations.lengths, 0.0
    )
    design = np.column_stack([dense(equations), own])
    size, width = found.size, len(design.T)
    prior = np.zeros((16, 3))
    prior[:, 1:] = sd**-2.0
    precision, pulled = np.zeros((width, width)), np.zeros(width)
    precision[:size, :size] = np.kron(np.eye(4), strength * equations.precision)
    precision[size : size + 48, size : size + 48] = np.diag(prior.ravel())
    pulled[size : size + 48] = -(prior * np.pad(shifts, [(0, 0), (1, 0)])).ravel()
    rows = np.pad(np.kron(np.eye(4), equations.conventions), [(0, 0), (0, width - size)])
    system = np.block([[design.T @ design + precision, rows.T], [rows, np.zeros((12, 12))]])
    right = np.append(design.T @ equations.residual + pulled, np.zeros(12))
    scale = np.sqrt(np.maximum(np.diag(system), 1.0))
    expected = linalg.lstsq(system / np.outer(scale, scale), right / scale)[0] / scale
    np.testing.assert_allclose(found, expected[:size], atol=1e-3 * np.abs(found).max())
    _, change, _ = equations.solved(state.nodes)  # whose strength is of a little influence
    moved = change[posterior.n_parameters :].reshape(16, 3)
    joint = expected[size : size + 48].reshape(16, 3)
    np.testing.assert_allclose(moved[:, 1:], joint[:, 1:], atol=0.05 * sd)


def test_splines_are_the_derivatives_of_the_light():
    posterior, _ = frame_of(4, side=61, grid=4)
    state = began(posterior, bf.find_map(posterior))
    rng, error = np.random.default_rng(1), 0.02
    equations = NodeEquations.of(posterior, state, error)
    change = rng.normal(size=state.nodes.coefficients.shape)
    light = equations.splines @ (equations.weights @ change.reshape(4, -1)).ravel()
    # by definition, pixel by pixel
    data = PsfSamples.at(posterior, state.params, state.shifts, state.grid.radius)
    psf = bf.MeasuredPSF(
        state.grid.combined(state.coefficients, change), state.grid.oversampling, 30.5, nodes=2
    )
    bare = bf.MeasuredPSF(psf.coefficients[:1], psf.oversampling, 30.5)
    s, samples = posterior.model.sources, data.samples
    values = np.zeros(samples.source.size)
    for n, k in enumerate(samples.source):
        at = samples.a[n], samples.b[n]
        both = [float(p.density(*at, at=(s.x[k], s.y[k]))) for p in (psf, bare)]
        values[n] = state.fluxes[k] * samples.size[n] * (both[0] - both[1])
    scale = float(state.grid.combined(state.coefficients)[0].sum()) / psf.oversampling**2
    expected = data.image(values) * scale
    expected *= np.sqrt(observed(posterior, state, data, error).weight)
    expected = expected[np.abs(expected) > 0.0]
    assert abs(np.sort(light[light != 0.0]) - np.sort(expected)).max() < 1e-8 * np.abs(light).max()


@pytest.mark.slow
def test_it_does_not_matter_where_the_first_psf_stopped():
    """Another PSF that does not vary and another background lead to the same places.

    Without a step of their own these stayed: the background 19 standard deviations apart.
    """
    posterior, _ = frame_of(6, side=125, grid=8, flux=3e5, number=2)
    estimate = bf.find_map(posterior)
    first, brighter = began(posterior, estimate), estimate.params.copy()
    known = solved(posterior, replace(first, nodes=None)).state.with_nodes(2)
    brighter[posterior.parameter_names.index("background")] *= 1.2
    starts = replace(first, params=brighter), known
    a, b = (_measured_at_nodes(posterior, state)[1].params for state in starts)
    assert np.all(np.abs(a - b) < np.sqrt(np.diag(estimate.covariance)))


def with_nodes_at(state, coefficients):
    shape = state.nodes.coefficients.shape
    return replace(state, nodes=replace(state.nodes, coefficients=coefficients.reshape(shape)))


def bright_frame():
    """A frame whose nodes are known to be thousands of standard deviations from zero."""
    posterior, _ = frame_of(6, side=125, grid=8, flux=3e7, number=2)
    estimate = bf.find_map(posterior)
    return posterior, estimate, began(posterior, estimate)


def test_what_does_not_vary_is_where_its_own_equations_lead(monkeypatch):
    """To 10 squared standard deviations of 1,383 unknowns.

    The control is one whose share of what all nodes have is never split off: 14.
    """
    posterior, _, start = bright_frame()
    start = start.with_nodes(3)

    def far():
        state = _measured_at_nodes(posterior, start)[1]
        return how_far(PsfEquations.of(posterior, state))

    assert far() < 10.0
    monkeypatch.setattr(fit_psf, "split", lambda state: state)
    assert far() > 10.0


def test_what_the_constant_and_all_nodes_can_have_is_split_by_their_priors():
    """The PSF stays what it was; any other split is less likely."""
    posterior, _ = frame_of(3, side=61, grid=4)
    start, rng = began(posterior, bf.find_map(posterior)), np.random.default_rng(1)
    side, own, conventions = start.grid.at_nodes
    free = linalg.null_space(conventions)
    some = 1e-3 * (free @ rng.normal(size=(free.shape[1], 4))).T
    state = with_nodes_at(start, some)
    found = split(state)

    def psfs(one):
        every = one.grid.combined(one.coefficients, one.nodes.coefficients)
        return every[1:] + every[0]

    def penalty(one):
        first, fine = one.grid.blocks[0], one.deviations[one.grid.blocks[0].where]
        precision = own.roughness.toarray() + np.diag(own.amplitude)
        each = one.nodes.coefficients.reshape(4, -1)
        rough = one.strengths[0] * fine @ (first.roughness @ fine)
        several = one.nodes.strength * np.sum(each * (each @ precision))
        return rough + fine @ (first.amplitude * fine) + several

    np.testing.assert_allclose(psfs(found), psfs(state), atol=1e-12)
    assert np.abs(conventions @ found.nodes.coefficients.reshape(4, -1).T).max() < 1e-12
    assert penalty(found) < 0.99 * penalty(state)
    # a bump that all nodes have, and the constant lacks
    bump = np.zeros((side, side))
    bump[side // 2 - 2 : side // 2 + 3, side // 2] = 1.0, -2.0, 2.0, -2.0, 1.0
    bump -= bump.T
    assert np.abs(conventions @ bump.ravel()).max() < 1e-12
    fine = halved(side) @ bump @ halved(side).T
    edge = (len(fine) - int(start.grid.unknown.side[0])) // 2
    fine = fine[edge : len(fine) - edge, edge : len(fine) - edge].ravel()
    for size in (-1e-5, 1e-5):
        each = found.nodes.coefficients.reshape(4, -1) + size * bump.ravel()
        deviations = found.deviations.copy()
        deviations[found.grid.blocks[0].where] -= size * fine
        other = replace(with_nodes_at(found, each), coefficients=found.deviating(deviations))
        np.testing.assert_allclose(psfs(other), psfs(found), atol=1e-12)
        assert penalty(other) > penalty(found)


def test_solutions_are_precise():
    """To a fraction of the parameters' errors; ten times less precise ones are 0.7 away."""
    posterior, estimate, start = bright_frame()
    equations = NodeEquations.of(posterior, start)
    found, exact = (
        equations.solved(start.nodes, *precise)[1][: posterior.n_parameters]
        for precise in ((), (1e-9,))
    )
    sd = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(found - exact) <= 0.2 * sd)


def measured(seed, scatter=0.0, **variation):
    posterior, theta = frame_of(seed, scatter=scatter)
    posterior, estimate = bf.measure_psf(
        posterior, bf.find_map(posterior), model_error=True, **variation
    )
    return posterior, estimate, theta


@pytest.mark.slow
def test_a_psf_that_turns_is_found_between_nodes_only():
    """Its ellipses are in nobody's reach but the nodes'; what is left is 1 % of the light."""
    posterior, estimate, _ = measured(1, nodes=NODES)
    psf, true = posterior.model.psf, turning_psf(0.5 * SIDE)
    assert estimate.fits_data
    assert estimate.params[posterior.parameter_names.index("model_error")] < 0.02
    a = np.linspace(-3.0, 3.0, 13)
    for at in [(0.0, 0.0), (70.0, -70.0), (100.0, 30.0)]:
        off = psf.density(a, a[:, None], at=at) - true.density(a, a[:, None], at=at)
        assert np.abs(off).max() < 0.03 * true.peak
    rough, _ = frame_of(1)
    polynomial = bf.fit_psf(rough, bf.find_map(rough), degree=2)
    assert polynomial.model_error > 0.05


def scores(frames, scatter=0.0):
    """Errors of the coefficients over those stated, and over those of a PSF that is known."""
    stated, known = [], []
    for seed in range(frames):
        posterior, estimate, theta = measured(seed, scatter, nodes=NODES)
        truth = dict(zip(posterior.model.distortion.names, theta, strict=True))
        truth |= {"offset_x": 0.0, "offset_y": 0.0}
        off = dict(zip(posterior.parameter_names, estimate.params, strict=True))
        bare = replace(posterior, psf_errors=None)
        for covariance, out in (
            (estimate.covariance, stated),
            (np.linalg.inv(bare.information(estimate.params)), known),
        ):
            errors = dict(zip(posterior.parameter_names, np.sqrt(np.diag(covariance)), strict=True))
            out.append([(off[n] - truth[n]) / errors[n] for n in truth])
    return np.array(stated), np.array(known)


@pytest.mark.statistics
def test_errors_hold_with_a_psf_that_varies_between_nodes():
    """40 frames, 12 coefficients: their rms is known to 5 %, were they independent.

    The control are the errors of a PSF that is taken for known.
    """
    stated, known = scores(40)
    assert 0.85 < np.sqrt(np.mean(stated**2)) < 1.15
    assert np.sqrt(np.mean(known**2)) > 1.1


@pytest.mark.statistics
def test_errors_hold_where_positions_scatter_too():
    """20 frames, 12 coefficients: their rms is known to 7 %, were they independent.

    Were shifts not to follow the parameters, all errors would be 2.2 times as large, and fail this.
    """
    stated, _ = scores(20, scatter=0.02)
    assert 0.8 < np.sqrt(np.mean(stated**2)) < 1.2


def test_files_and_choices():
    psf = turning_psf(50.0)
    assert (psf.degree, psf.nodes, psf.varies) == (0, NODES, True)
    with pytest.raises(bf.InputError, match=r"coefficients: got shape \(7, 65, 65\)"):
        bf.MeasuredPSF(psf.coefficients[:7], 4.0, 50.0, nodes=NODES)
    with pytest.raises(bf.InputError, match="expected one of them"):
        measuring.find_psf(None, None, 4, 2, NODES)
    with pytest.raises(bf.InputError, match="nodes: got 1"):
        measuring.find_psf(None, None, 4, 0, 1)


def test_sources_that_show_only_their_wings_are_masked():
    posterior, _ = frame_of(1, side=61, grid=4)
    state = began(posterior, bf.find_map(posterior))
    x, y = posterior.likelihood.image_positions(state.params)[5]
    u, v = posterior.model.detector.pixel_centres()
    distance = np.hypot(u - x, v[:, None] - y)
    hidden = replace(posterior, mask=posterior.mask & (distance > 3.0 * SIGMA))
    lit = lit_pixels(hidden, state)
    assert not lit[distance < 5.0].any() and lit[distance > 12.0].all()
    assert np.array_equal(lit_pixels(posterior, state), posterior.mask)


def test_errors_on_another_frame_are_refused():
    """The draws are of what all sources have in common: errors made of them would be too small."""
    posterior, _ = frame_of(1, side=61, grid=4)
    psf = turning_psf(30.5)
    other = posterior.with_psf(replace(psf, draws=psf.coefficients[None, :1]))
    with pytest.raises(bf.InputError, match="expected one with a degree"):
        bf.marginalize_psf(other, None)


def test_a_file_keeps_the_nodes(tmp_path):
    psf = turning_psf(50.0)
    psf.write(tmp_path / "psf.fits")
    again = bf.MeasuredPSF.read(tmp_path / "psf.fits")
    assert again.nodes == NODES
    np.testing.assert_array_equal(again.coefficients, psf.coefficients)


def test_photutils_interpolates_between_the_same_nodes():
    pytest.importorskip("photutils.psf")
    psf = turning_psf(50.0)
    gridded = psf.to_photutils((101, 101))
    gridded.x_0, gridded.y_0 = 30.0, 71.0
    a, b = np.array([0.2, -1.1, 0.7]), np.array([-0.3, 0.4, 1.5])
    expected = psf.density(a, b, at=(30.0 - 50.0, 71.0 - 50.0))
    np.testing.assert_allclose(gridded(30.0 + a, 71.0 + b), expected, atol=2e-3 * psf.peak)

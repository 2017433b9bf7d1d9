"""The recipe of a distortion basis: a matrix T, written here, goes through everything.

The terms are those of a cubic polynomial in (x, y); the basis is products of Legendre polynomials
in coordinates that run from -1 to 1 over the frame, less their constants, and mixed by a shear.
Everything found in it has to be what is found in monomials, turned by T.
"""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.polynomial import Legendre, Polynomial
from scipy import stats

import bayesfred as bf
from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io import serialize

SIDE = 105
HALF = 0.5 * SIDE
PLAIN = bf.PolynomialDistortion.polynomial(3)


def legendre() -> bf.PolynomialDistortion:
    """P_i(x / HALF) P_j(y / HALF) less its constant for 1 <= i + j <= 3, with a shear on top."""
    powers = [(i, j) for i, j, _, _ in PLAIN.f_terms]
    block = np.zeros((9, 9))
    for column, degrees in enumerate(powers):
        in_x, in_y = (Legendre.basis(k).convert(kind=Polynomial).coef for k in degrees)
        for row, (i, j) in enumerate(powers):
            if i < len(in_x) and j < len(in_y):
                block[row, column] = in_x[i] * in_y[j] / HALF ** (i + j)
    shear = np.eye(18) + 0.5 * np.eye(18, k=9) + 0.25 * np.eye(18, k=-1)
    labels = [f"{letter}_p{i}{j}" for letter in "fg" for i, j in powers]
    basis = np.kron(np.eye(2), block) @ shear
    return bf.PolynomialDistortion(PLAIN.f_terms, PLAIN.g_terms, basis, labels)


BASIS = legendre()


def model_of(distortion: bf.PolynomialDistortion) -> bf.ForwardModel:
    detector, psf = bf.Detector((SIDE, SIDE)), bf.GaussianPSF(2.0)
    return bf.ForwardModel(detector, bf.SourceCatalog.grid(7, 14.0, 1e4), psf, distortion)


TRUTH = 0.4 * np.random.default_rng(1).standard_normal(18)  # pixel
FLAT = stats.norm(0.0, 1e4)


@pytest.fixture(scope="module")
def counts() -> Floats:
    return bf.simulate(model_of(BASIS), TRUTH, 3.0, seed=2)


def posterior_of(distortion: bf.PolynomialDistortion, counts: Floats) -> bf.Posterior:
    """With priors that say next to nothing, so that the likelihood alone makes the maximum."""
    prior = dict.fromkeys(distortion.names, FLAT)
    return bf.Posterior(model_of(distortion), counts, prior=prior)


@pytest.fixture(scope="module")
def estimates(counts: Floats) -> tuple[bf.MapEstimate, bf.MapEstimate]:
    return (
        bf.find_map(posterior_of(BASIS, counts)),
        bf.find_map(posterior_of(PLAIN, counts)),
    )


def turned(size: int) -> Floats:
    """T, and the identity for the parameters that are no coefficients."""
    out = np.eye(size)
    assert BASIS.basis is not None
    out[:18, :18] = BASIS.basis
    return out


def test_images_are_those_of_the_monomials() -> None:
    theta = BASIS.monomial_coefficients(TRUTH)
    image, plain = model_of(BASIS).expected_counts(TRUTH), model_of(PLAIN).expected_counts(theta)
    assert np.array_equal(image, plain)
    assert not np.allclose(image, model_of(PLAIN).expected_counts(0.0 * theta), rtol=1e-3)
    u, v = BASIS.image_position(TRUTH, 20.0, -30.0)
    assert (u, v) == PLAIN.image_position(theta, 20.0, -30.0)
    x, y = BASIS.object_position(TRUTH, u, v)
    assert (float(x), float(y)) == pytest.approx((20.0, -30.0))
    assert BASIS.determinant(TRUTH, u, v, x, y) == PLAIN.determinant(theta, u, v, x, y)


def five_point(function: object, params: Floats, steps: Floats) -> Floats:
    """Derivatives along every parameter, their error of fourth order in the step."""
    out = []
    for k, step in enumerate(steps):
        h = np.zeros(params.size)
        h[k] = step
        f = [np.asarray(function(params + m * h)) for m in (-2, -1, 1, 2)]  # type: ignore[operator]
        out.append((f[0] - 8.0 * f[1] + 8.0 * f[2] - f[3]) / (12.0 * step))
    return np.array(out)


@pytest.mark.parametrize(
    "distortion",
    [BASIS, bf.PolynomialDistortion.zernike(3, HALF), bf.PolynomialDistortion.radial_tangential()],
    ids=["legendre", "zernike", "radial_tangential"],
)
def test_derivatives_are_those_of_differences(distortion: bf.PolynomialDistortion) -> None:
    """A coefficient moves images by at most 0.02 pixels a step, a hundredth of the PSF's width.

    The truncation error is then 1e-8 / 30 times the ratio of fifth and first derivatives. All
    pixels are visited: the windows of a tolerance move with the coefficients.
    """
    sources = bf.SourceCatalog.grid(3, 32.0, 1e4)
    model = replace(model_of(distortion), sources=sources, tolerance=0.0)
    largest = distortion.largest_displacement(HALF, HALF).max(axis=0)
    theta = 0.3 * np.random.default_rng(3).standard_normal(distortion.n_terms) / largest
    jacobian = model.jacobian(theta)
    differences = five_point(model.expected_counts, theta, 0.02 / largest)
    for exact, difference in zip(jacobian, differences, strict=True):
        assert exact == pytest.approx(difference, rel=0, abs=1e-6 * np.abs(difference).max())
    nuisances = bf.Nuisances("free", offset=True, psf_sigma=True)
    counts = bf.simulate(model, theta, 3.0, seed=2)
    posterior = bf.Posterior(model, counts, nuisances=nuisances)
    params = posterior.start()
    params[: distortion.n_terms] = theta
    steps = np.where(params > 0, 1e-3 * np.abs(params), 1e-3)
    steps[: distortion.n_terms] = 0.02 / largest
    slope = five_point(posterior.log_prob, params, steps)
    scale = np.sqrt(np.diag(posterior.information(params)))
    assert posterior.gradient(params) / scale == pytest.approx(slope / scale, rel=1e-5, abs=1e-3)


def test_information_is_pulled_back(counts: Floats) -> None:
    params = np.append(TRUTH, 3.0)
    there = turned(19) @ params
    basis, plain = posterior_of(BASIS, counts), posterior_of(PLAIN, counts)
    expected = turned(19).T @ plain.fisher(there) @ turned(19)
    scale = np.sqrt(np.diag(expected))
    assert basis.fisher(params) / np.outer(scale, scale) == pytest.approx(
        expected / np.outer(scale, scale), rel=0, abs=1e-10
    )
    # the negative control: the other way round it is another matrix
    wrong = turned(19) @ plain.fisher(there) @ turned(19).T
    assert not np.allclose(wrong / np.outer(scale, scale), expected / np.outer(scale, scale))


def test_the_maximum_and_its_errors_are_the_same(
    estimates: tuple[bf.MapEstimate, bf.MapEstimate],
) -> None:
    basis, plain = estimates
    assert basis.at_maximum and plain.at_maximum
    sd = np.sqrt(np.diag(plain.covariance))
    assert (turned(19) @ basis.params - plain.params) / sd == pytest.approx(0.0, abs=1e-3)
    covariance = turned(19) @ basis.covariance @ turned(19).T
    assert covariance / np.outer(sd, sd) == pytest.approx(
        plain.covariance / np.outer(sd, sd), rel=0, abs=1e-4
    )
    own = np.sqrt(np.diag(basis.covariance))[:18]
    assert np.abs((basis.params[:18] - TRUTH) / own).max() < 4.5
    at = (20.0, -30.0, 20.0, -30.0)
    f, g = BASIS.displacement(basis.params[:18], *at)
    f_plain, g_plain = PLAIN.displacement(plain.params[:18], *at)
    assert (float(f), float(g)) == pytest.approx((float(f_plain), float(g_plain)), abs=1e-5)


@pytest.mark.slow
def test_free_fluxes_are_profiled_alike(counts: Floats) -> None:
    """`near` extrapolates fluxes in theta, whatever its basis."""
    nuisances = bf.Nuisances("free")
    prior = dict.fromkeys(BASIS.names, FLAT)
    posterior = bf.Posterior(model_of(BASIS), counts, prior=prior, nuisances=nuisances)
    best = bf.find_map(posterior)
    assert best.at_maximum
    near = posterior.near(best.params, best.covariance)
    draws = np.random.default_rng(4).multivariate_normal(best.params, best.covariance, 20)
    assert near.log_prob(draws) == pytest.approx(posterior.log_prob(draws), abs=1e-4)


def test_draws_are_those_of_the_basis_and_come_back(
    counts: Floats, estimates: tuple[bf.MapEstimate, bf.MapEstimate], tmp_path: Path
) -> None:
    basis, plain = estimates
    posterior = posterior_of(BASIS, counts)
    path = tmp_path / "chain.h5"
    chain = bf.sample(posterior, basis, seed=5, path=path)
    assert chain.parameter_names == (*BASIS.names, "background")
    result = bf.diagnose(chain)
    assert result.sampled_well and result.prior_dominated == ()
    draws = chain.chain[:, chain.burn_in :].reshape(-1, 19)
    z = (draws @ turned(19).T - plain.params) / np.sqrt(np.diag(plain.covariance))
    # the posterior is Gaussian to a few per cent; 1000 effective draws know it to 3 %
    assert z.mean(axis=0) == pytest.approx(0.0, abs=0.2)
    assert z.std(axis=0) == pytest.approx(1.0, abs=0.15)
    # the negative control: in another basis they are other numbers
    assert np.abs((draws - plain.params) / np.sqrt(np.diag(plain.covariance))).max() > 100.0
    again = chain.posterior().model.distortion
    assert again == BASIS and again.names == BASIS.names
    assert chain.posterior().log_prob(draws[0]) == posterior.log_prob(draws[0])


def test_bases_are_values() -> None:
    same = legendre()
    assert same == BASIS and hash(same) == hash(BASIS) and same is not BASIS
    assert pickle.loads(pickle.dumps(BASIS)) == BASIS
    assert BASIS != PLAIN and BASIS.basis is not None
    other = bf.PolynomialDistortion(PLAIN.f_terms, PLAIN.g_terms, 2.0 * BASIS.basis, BASIS.names)
    assert other != BASIS
    with pytest.raises(ValueError, match="read-only"):
        BASIS.basis[0, 0] = 1.0
    with h5py.File("basis.h5", "w", driver="core", backing_store=False) as file:
        serialize.write(file, BASIS)
        assert serialize.read(file, bf.PolynomialDistortion) == BASIS


def test_rows_do_not_depend_on_each_other() -> None:
    thetas = np.random.default_rng(6).standard_normal((37, 18))
    together = BASIS.monomial_coefficients(thetas)
    assert together == pytest.approx(thetas @ np.asarray(BASIS.basis).T)
    for n in (1, 2, 36):
        assert np.array_equal(BASIS.monomial_coefficients(thetas[:n]), together[:n])
    assert np.array_equal(BASIS.monomial_coefficients(thetas[5]), together[5])


@pytest.mark.parametrize(
    ("basis", "labels", "message"),
    [
        ([[1.0, 0.0]], "a b", r"basis: got shape \(1, 2\), expected \(2,"),
        ([1.0, 2.0], "a", r"basis: got shape \(2,\)"),
        ([[1.0], [np.nan]], "a", "basis: got values that are not finite"),
        ([[1.0, 0.0], [1.0, 0.0]], "a b", "basis: got zeros alone in column 1"),
        ([["x"], ["y"]], "a", "basis: got values that are not numbers"),
        ([[1.0], [1.0]], "", "labels: got none, expected 1"),
        ([[1.0], [1.0]], "a b", "labels: got a, b, expected 1"),
        ([[1.0, 0.0], [0.0, 1.0]], "a a", "labels: got a, a, expected 2 different"),
        ([[1.0], [1.0]], "f-x", "labels: got f-x, expected 1 different identifiers"),
        (None, "a b", "labels: got a, b, expected 0"),
    ],
)
def test_bad_bases_are_refused_in_one_line(basis: object, labels: str, message: str) -> None:
    terms = ([(1, 0, 0, 0)], [(0, 1, 0, 0)])
    with pytest.raises(InputError, match=message) as error:
        bf.PolynomialDistortion(*terms, basis, labels)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)

"""Thirty general terms, of which many pairs are nearly the same: fitted, sampled and judged.

u is nearly x, so that a frame tells u x from x^2 by the shapes of images alone. It knows the sum of
two such coefficients to a millionth of what it leaves of their difference, which moves nothing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import bayesfred as bf
from bayesfred._typing import Floats
from bayesfred.analysis.diagnostics import Diagnostics
from bayesfred.analysis.sensitivity import INFORMATIVE
from bayesfred.sampling.moves import LaplaceMove

SIDE = 205
HALF = 0.5 * SIDE


def thirty_terms(seed: int) -> bf.PolynomialDistortion:
    """15 terms each for f and g, out of all up to total degree 3."""
    rng = np.random.default_rng(seed)
    terms = bf.PolynomialDistortion.full_polynomial(3).f_terms
    f, g = ([terms[k] for k in sorted(rng.choice(len(terms), 15, replace=False))] for _ in range(2))
    return bf.PolynomialDistortion(f, g)


def frame_of(distortion: bf.PolynomialDistortion) -> tuple[bf.Posterior, Floats]:
    """A frame in which every term moves the corner by about a pixel, and the truth."""
    model = bf.ForwardModel(
        bf.Detector((SIDE, SIDE)),
        bf.SourceCatalog.grid(9, 24.0, 3e3),
        bf.GaussianPSF(2.5),
        distortion,
    )
    largest = distortion.largest_displacement(HALF, HALF).max(axis=0)
    theta = np.random.default_rng(7).standard_normal(distortion.n_terms) / largest
    return bf.Posterior(model, bf.simulate(model, theta, 5.0, seed=3)), theta


def field(half: float) -> tuple[Floats, Floats]:
    x, y = np.meshgrid(*2 * [np.linspace(-half, half, 9)])
    return x.ravel(), y.ravel()


def displacements(distortion: bf.PolynomialDistortion, theta: Floats, half: float) -> Floats:
    """f and g of a unit of every coefficient all over a square, shape (2 * points, n_terms)."""
    x, y = field(half)
    u, v = distortion.image_position(theta, x, y)
    return distortion.design_matrix(u, v, x, y).reshape(-1, distortion.n_terms)


def judged(posterior: bf.Posterior, path: Path) -> tuple[bf.MapEstimate, Floats, Diagnostics]:
    estimate = bf.find_map(posterior)
    chain = bf.sample(posterior, estimate, seed=4, path=path)
    draws = chain.chain[:, chain.burn_in :].reshape(-1, len(chain.parameter_names))
    return estimate, draws, bf.diagnose(chain)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_the_frame_knows_is_not_prior_dominated(seed: int, tmp_path: Path) -> None:
    distortion = thirty_terms(seed)
    posterior, theta = frame_of(distortion)
    estimate, draws, result = judged(posterior, tmp_path / "chain.h5")
    sd = np.sqrt(np.diag(estimate.covariance))
    pairs = np.abs(estimate.covariance / np.outer(sd, sd)) > 0.999
    assert pairs.sum() > sd.size  # not the diagonal alone
    # The frame knows the displacement, and rightly, to a fortieth of what the prior allows each
    # term: 10 pixels.
    design = displacements(distortion, estimate.params[:30], HALF)
    design = design[design.any(axis=1)]  # nothing moves on the axis
    known = np.sqrt(np.einsum("ij,jk,ik->i", design, np.cov(draws[:, :30].T), design))
    assert known.max() < 0.25
    assert np.abs(design @ (estimate.params[:30] - theta) / known).max() < 5.0
    assert result.prior_dominated == ()
    # the negative control: coefficient by coefficient the prior does decide
    assert sum(s >= INFORMATIVE for s in result.prior_sensitivity.values()) >= 5
    assert result.sampled_well and result.acceptance > 0.8


def test_a_displacement_that_only_the_prior_knows_is_named(tmp_path: Path) -> None:
    """Stars on the line y = 0 say nothing about y^3, and as little of ux - x^2 as any others."""
    distortion = bf.PolynomialDistortion(
        [(1, 0, 1, 0), (2, 0, 0, 0), (1, 0, 2, 0), (3, 0, 0, 0), (0, 3, 0, 0)], []
    )
    x = np.linspace(-90.0, 90.0, 13)
    model = bf.ForwardModel(
        bf.Detector((SIDE, SIDE)),
        bf.SourceCatalog(x, np.zeros(13), np.full(13, 300.0)),
        bf.GaussianPSF(2.5),
        distortion,
    )
    prior = {"f_y3": stats.norm(0.0, 0.03 / HALF**2)}
    posterior = bf.Posterior(model, bf.simulate(model, np.zeros(5), 5.0, seed=3), prior=prior)
    _, _, result = judged(posterior, tmp_path / "chain.h5")
    assert result.prior_dominated == ("f_y3",)
    others = [name for name, s in result.prior_sensitivity.items() if s >= INFORMATIVE]
    assert {"f_ux", "f_x2"} & set(others)


def test_the_maximum_is_found_alike_in_other_coordinates() -> None:
    """Of the same thirty terms mixed at random, the displacement and its errors are the same."""
    plain = thirty_terms(2)
    posterior, _ = frame_of(plain)
    scale = 1.0 / plain.largest_displacement(HALF, HALF).max(axis=0)
    mixed = np.random.default_rng(5).standard_normal((30, 30))
    basis = scale[:, None] * mixed
    labels = [f"c{k}" for k in range(30)]
    other = bf.PolynomialDistortion(plain.f_terms, plain.g_terms, basis, labels)
    wide = {name: stats.norm(0.0, 100.0 * s) for name, s in zip(plain.names, scale, strict=True)}
    found = bf.find_map(bf.Posterior(posterior.model, posterior.counts, prior=wide))
    model = bf.ForwardModel(
        posterior.model.detector, posterior.model.sources, posterior.model.psf, other
    )
    wide = {name: stats.norm(0.0, 1000.0) for name in labels}
    again = bf.find_map(bf.Posterior(model, posterior.counts, prior=wide))
    assert found.at_maximum and again.at_maximum
    design = displacements(plain, found.params[:30], HALF)
    covariance = found.covariance[:30, :30]
    sd = np.sqrt(np.einsum("ij,jk,ik->i", design, covariance, design))
    there = design @ (found.params[:30] - other.monomial_coefficients(again.params[:30]))
    # the priors differ, and tell by a small part of the frame's errors
    assert np.abs(there[sd > 0] / sd[sd > 0]).max() < 0.1
    turned = design @ basis
    sd_again = np.sqrt(np.einsum("ij,jk,ik->i", turned, again.covariance[:30, :30], turned))
    assert sd_again == pytest.approx(sd, rel=0.02)


def test_proposals_follow_covariances_that_are_nearly_singular() -> None:
    """Correlations of 1 - 1e-10 beside scales of 1e-18: the draws have the covariance."""
    rng = np.random.default_rng(1)
    rotation = np.linalg.qr(rng.standard_normal((12, 12)))[0]
    root = 10.0 ** -np.arange(7, 19)[:, None] * rotation * np.geomspace(1.0, 1e-5, 12)
    covariance = root @ root.T
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    assert np.linalg.cond(correlation) > 1e8
    move = LaplaceMove(np.zeros(12), covariance)
    draws = move.draw(20000, np.random.RandomState(2))
    whitened = np.linalg.solve(root, draws.T)
    middle = np.quantile(whitened, [0.16, 0.84], axis=1)
    # the heavy share of 5 % widens the middle 68 % by 2 %; its Monte Carlo error is 1 %
    assert middle[1] - middle[0] == pytest.approx(2.0, rel=0.06)
    plain = LaplaceMove(np.zeros(12), np.eye(12)).log_density(whitened.T)
    shift = move.log_density(draws) - plain + np.linalg.slogdet(root)[1]
    assert np.abs(shift).max() < 1e-3

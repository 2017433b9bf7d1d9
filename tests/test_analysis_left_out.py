"""Sources left out where the PSF is measured, and what explains the variety of their shapes."""

from dataclasses import replace

import numpy as np
import pytest
from test_optimize_fit_psf import frame_of

import bayesfred as bf
from bayesfred.analysis.folds import fold_sources
from bayesfred.analysis.left_out import Weights, leave_out, measured_here
from bayesfred.analysis.sources import source_table

BENT = bf.PolynomialDistortion([(1, 0, 0, 0), (1, 0, 1, 0)], [(0, 1, 0, 0)])
PLACES = bf.PolynomialDistortion([(1, 0, 0, 0), (2, 0, 0, 0)], [(0, 1, 0, 0)])


def frame(stretch: float) -> bf.Posterior:
    """Stars whose images a term u x stretches along u: to the right more than to the left."""
    _, _, posterior = frame_of(bf.GaussianPSF(1.3), 3.0, pixel="impulse")
    model = replace(posterior.model, psf=bf.GaussianPSF(1.3), distortion=BENT)
    counts = bf.simulate(model, [0.0, stretch, 0.0], 5.0, seed=2)
    return bf.Posterior(posterior.model, counts, nuisances=posterior.nuisances)


def chain(posterior: bf.Posterior, distortion: bf.PolynomialDistortion, degree: int) -> bf.Chain:
    model = replace(posterior.model, distortion=distortion)
    own = bf.Posterior(model, posterior.counts, nuisances=posterior.nuisances)
    measured, estimate = bf.measure_psf(own, bf.find_map(own), degree=degree)
    return bf.laplace(measured, estimate, seed=1, progress=False)


@pytest.mark.slow
def test_what_stretches_images_is_told_from_a_psf_that_varies():
    """By the share of the stars' variety that each explains; without any there is no share."""
    shares = {}
    for stretch in (2e-3, 0.0):
        posterior = frame(stretch)
        found = bf.compare(
            {
                "one PSF": chain(posterior, PLACES, 0),
                "kernel": chain(posterior, BENT, 0),
                "varying PSF": chain(posterior, PLACES, 1),
            }
        )
        shares[stretch] = {s.name: (s.explained, s.explained_se) for s in found.scores}
        best = "kernel" if stretch else "one PSF"
        elpd = {s.name: s.elpd for s in found.scores}
        assert elpd[best] > max(elpd["varying PSF"], elpd["one PSF"]) - 4.0
        assert any("explains" in line for line in found.sentences) == bool(stretch)
    there, absent = shares[2e-3], shares[0.0]
    share, error = there["kernel"]
    # of the whole misfit nothing is left, to the standard error of 20 folds
    assert error < 0.1 and abs(share - 1.0) < 4.0 * error
    share, error = there["varying PSF"]
    assert share > 0.5 and share < there["kernel"][0] + 3.0 * error
    assert np.isnan([each for pair in absent.values() for each in pair]).all()


@pytest.mark.slow
def test_a_source_does_not_tell_what_is_predicted_of_it():
    """One that is 0.5 px off its place draws the fit to all, but not what the others predict."""
    posterior = frame(0.0)
    sources = posterior.model.sources
    x = sources.x.copy()
    x[7] += 0.5
    moved = replace(posterior.model, sources=bf.SourceCatalog(x, sources.y, sources.flux))
    own = bf.Posterior(moved, posterior.counts, nuisances=posterior.nuisances)
    own, estimate = bf.measure_psf(own, bf.find_map(own))
    assert measured_here(own) and not measured_here(posterior)
    folds = fold_sources(own, estimate.params, 20)
    weights = Weights.of(own, estimate.params)
    left = leave_out(own, estimate, folds, weights, np.random.RandomState(1))
    assert list(left.sources["id"]) == list(range(36))
    # 36 stars of 1e5 photons: each is known to 0.005 px, their prediction of one to 0.003 px
    fitted = source_table(own, estimate.params)["du"][7]
    assert abs(left.sources["du"][7] + 0.5) < 0.03 < abs(fitted + 0.5)
    worst = np.argmax(left.misfit)
    assert folds.sources[7] == worst

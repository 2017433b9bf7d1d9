"""Sources that do not fit are left out, where it is they and not the model."""

from dataclasses import replace

import numpy as np
import pytest

from bayesfred.analysis.failed_sources import leave_out_failed
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.psf import GaussianPSF, MoffatPSF
from bayesfred.model.noise import simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map
from tests.planted import HALF, LEVEL, SHAPE, SIGMA, THETA, camera, field

FREE = Nuisances(flux="free", background_order=0)


def joined(*parts):
    names = ("x", "y", "flux")
    return SourceCatalog(*(np.concatenate([getattr(s, n) for s in parts]) for n in names))


def blended(seed, rows, share=0.5, apart=2.0):
    """A catalogue, and the sources that are imaged: some have companions that it lacks."""
    s = field(seed)
    s = SourceCatalog(s.x, s.y, 5.0 * s.flux)
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(rows))
    beside = SourceCatalog(
        s.x[rows] + apart * np.cos(angle), s.y[rows] + apart * np.sin(angle),
        share * s.flux[rows],
    )  # fmt: skip
    return s, joined(s, beside)


def posterior_of(catalogue, imaged, psf=GaussianPSF(SIGMA)):
    counts = simulate(camera(imaged, psf=psf), THETA, LEVEL, seed=len(imaged))
    return Posterior(camera(catalogue), counts, nuisances=FREE)


def distance(estimate):
    """Of the coefficients from the truth: chi-square over degrees."""
    off, terms = estimate.params[: len(THETA)] - THETA, slice(0, len(THETA))
    return float(off @ np.linalg.solve(estimate.covariance[terms, terms], off)) / len(THETA)


def test_sources_with_companions_are_left_out():
    """And no others, though these pull a dozen away; the coefficients are the lens's.

    The chi-square per degree of 4 coefficients has a standard deviation of 0.7.
    """
    rows = [7, 30]
    catalogue, imaged = blended(3, rows)
    posterior = posterior_of(catalogue, imaged)
    estimate = find_map(posterior)
    kept, found, message = leave_out_failed(posterior, estimate)
    s = catalogue
    names = "; ".join(f"{k} at x, y = {s.x[k]:.1f}, {s.y[k]:.1f}" for k in rows)
    assert message == (
        f"2 of 48 sources do not fit and are left out: rows of the catalogue, from 0: {names}"
    )
    assert distance(found) < 3.5
    assert distance(estimate) > 10.0
    # what is masked is nearer to them than to any other, and all that has their light
    gone = posterior.mask & ~kept.mask
    images = kept.likelihood.image_positions(found.params)
    row, column = np.indices(SHAPE)
    away = np.hypot(column[..., None] - HALF - images[:, 0], row[..., None] - HALF - images[:, 1])
    theirs, others = away[..., rows].min(axis=-1), np.delete(away, rows, axis=-1).min(axis=-1)
    moved = 0.5  # pixel, as the coefficients changed
    assert np.all(theirs[gone] < others[gone] + moved)
    assert theirs[gone].max() < 8.0 * SIGMA
    assert gone[(theirs < others - moved) & (theirs < 6.0 * SIGMA)].all()


@pytest.mark.parametrize("seed", range(4))
def test_none_is_left_out_where_all_fit(seed):
    """By chance it would be in 0.3 % of frames."""
    sources = field(seed)
    posterior = posterior_of(sources, sources)
    estimate = find_map(posterior)
    kept, found, message = leave_out_failed(posterior, estimate)
    assert kept is posterior
    assert found is estimate
    assert not message


def test_none_is_left_out_where_many_do_not_fit():
    """Nine of 48, of any brightness; nor of a posterior whose maximum was not found."""
    for rows, at_maximum, left_out in (
        (np.arange(0, 45, 5), True, False), ([7, 30], False, False), ([7, 30], True, True),
    ):  # fmt: skip
        posterior = posterior_of(*blended(3, rows))
        estimate = replace(find_map(posterior), at_maximum=at_maximum)
        kept, _, message = leave_out_failed(posterior, estimate)
        assert (kept is not posterior) == left_out
        assert bool(message) == left_out


def test_none_is_left_out_where_the_model_is_wrong():
    sources = field(5)
    bright = SourceCatalog(sources.x, sources.y, 10.0 * sources.flux)
    posterior = posterior_of(bright, bright, MoffatPSF(2.3548 * SIGMA, 2.5))
    estimate = find_map(posterior)
    kept, _, message = leave_out_failed(posterior, estimate)
    assert kept is posterior
    assert not message


def test_none_is_left_out_where_the_brightest_do_not_fit():
    """As in a detector in which the images of bright stars are wider. Of the faintest they are."""
    sources = field(6)
    order = np.argsort(sources.flux)
    for some, left_out in ((order[-4:], False), (order[:4], True)):
        flux = 10.0 * sources.flux
        flux[some] *= 3.0 if not left_out else 1.0
        flux[order[:4]] = np.maximum(flux[order[:4]], 2e4)
        others = np.setdiff1d(np.arange(len(flux)), some)
        parts = [SourceCatalog(sources.x[k], sources.y[k], flux[k]) for k in (some, others)]
        wide = simulate(camera(parts[0], psf=GaussianPSF(1.25 * SIGMA)), THETA, LEVEL / 2, seed=1)
        counts = wide + simulate(camera(parts[1]), THETA, LEVEL / 2, seed=2)
        posterior = Posterior(camera(joined(*parts)), counts, nuisances=FREE)
        kept, _, message = leave_out_failed(posterior, find_map(posterior))
        assert (kept is not posterior) == left_out
        assert message.startswith("4 of 48") == left_out

"""Spots that are in no catalogue and sources that are missing from the frame: found, and left out on the way to the maximum."""

import numpy as np
import pytest
from numpy.typing import NDArray

from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.imaging.scene import SourceCatalog
from bayesfred.inference import start
from bayesfred.inference.ascent import climb
from bayesfred.inference.noise import simulate
from bayesfred.inference.posterior import Nuisances, Posterior
from bayesfred.inference.start import Field, find_start
from bayesfred.inference.unexplained import explained, settled, unexplained

Floats = NDArray[np.float64]

COMPLETE = PolynomialDistortion.complete(3)
FLUX, BACKGROUND = 1e4, 2.0


def frame(
    seed: int,
    n: int = 8,
    spacing: float = 20.0,
    sigma: float = 2.0,
    nuisances: Nuisances = Nuisances(),
    binning: int = 1,
) -> tuple[Posterior, Floats, NDArray[np.int64], Floats]:
    """A grid of 9 x 9 stars without n of them, and with n spots elsewhere: posterior, truth, stars without a spot, spots."""
    rng = np.random.default_rng(seed)
    sources = SourceCatalog.grid(9, spacing, FLUX)
    detector = Detector((round(11 * spacing / binning),) * 2, binning)
    model = ForwardModel(detector, sources, GaussianPSF(sigma), COMPLETE)
    missing = np.sort(rng.choice(81, n, replace=False))
    spots = rng.uniform(-4.0, 4.0, (2, n)) * spacing
    scale = Field(Posterior(model, np.ones(detector.shape))).scale
    theta = 0.03 * scale * rng.standard_normal(scale.size)
    x, y = (np.append(np.delete(axis, missing), more) for axis, more in zip((sources.x, sources.y), spots, strict=True))
    real = ForwardModel(detector, SourceCatalog(x, y, np.full(x.size, FLUX)), model.psf, COMPLETE)
    counts = simulate(real, theta, BACKGROUND * binning**2, seed=seed)
    posterior = Posterior(model, counts, nuisances=nuisances)
    return posterior, np.append(theta, [BACKGROUND * binning**2, 0.0, 0.0])[: posterior.n_parameters], missing, spots.T


def error(posterior: Posterior, params: Floats, truth: Floats) -> float:
    """Largest distance between predicted and true images, in PSF widths."""
    field = Field(posterior)
    places, true = (field.predict(each[field.columns]) for each in (params, truth))
    return float(np.hypot(*(places - true).T).max() / posterior.model.psf.sigma)


@pytest.mark.parametrize("options", [{}, {"sigma": 3.0, "binning": 2}, {"nuisances": Nuisances(offset=True)}])
def test_what_is_unexplained_is_found(options: dict[str, float]) -> None:
    posterior, truth, missing, spots = frame(1, **options)
    lost, number, image = unexplained(posterior, truth)
    assert np.flatnonzero(lost).tolist() == missing.tolist() and number == 8
    assert image.sum() == pytest.approx(8 * FLUX, rel=0.1)
    column, row = np.rint(spots / posterior.model.detector.binning + 0.5 * (image.shape[0] - 1)).astype(int).T
    assert image[row, column].min() > 0.5 * image.max()
    part = explained(posterior, truth)
    assert not part.mask[row, column].any() and 0.9 < part.mask.mean() < 1.0
    assert part.model.sources.flux[missing].max() < 1e-3 and np.all(np.delete(part.model.sources.flux, missing) == FLUX)


def test_nothing_is_left_out_where_the_catalogue_is_right_or_the_parameters_are_wrong() -> None:
    posterior, truth, *_ = frame(1, n=0)
    assert explained(posterior, truth) is posterior
    assert settled(posterior, truth, 8) is truth
    elsewhere = Posterior(posterior.model, np.roll(posterior.counts, 10, axis=1))  # half a spacing
    lost, number, _ = unexplained(elsewhere, truth)
    assert lost.all() and number > 70
    assert explained(elsewhere, truth) is elsewhere
    # where no pixel would be left, none is left out
    few = np.zeros(posterior.counts.shape, bool)
    few[100:103, 100:103] = True
    bright = Posterior(posterior.model, np.where(few, 1e4, 0.0), mask=few)
    assert explained(bright, truth) is bright


def test_free_fluxes_fall_where_a_source_is_missing() -> None:
    posterior, truth, missing, _ = frame(1, nuisances=Nuisances("free"))
    lost, number, _ = unexplained(posterior, truth)
    assert lost.sum() < len(missing) and number == 8
    assert posterior.fluxes(truth)[missing].max() < 0.5 * FLUX


def test_masked_pixels_hold_nothing_unexplained() -> None:
    posterior, truth, missing, spots = frame(1)
    v, u = np.indices(posterior.counts.shape) - 0.5 * (posterior.counts.shape[0] - 1)
    s = posterior.model.sources
    mask = np.ones(posterior.counts.shape, bool)
    for x, y in [*spots, *zip(s.x[missing], s.y[missing], strict=True)]:
        mask &= (u - x) ** 2 + (v - y) ** 2 > 12.0**2
    counts = np.where(mask, posterior.counts, 1e6)
    masked = Posterior(posterior.model, counts, mask=mask)
    assert explained(masked, truth) is masked


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_search_settles_near_the_truth_before_the_last_climb(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    posterior, truth, *_ = frame(seed)
    begun = find_start(posterior)
    near = error(posterior, begun.params, truth)
    assert begun.path == "matched peaks" and near < 0.1
    # negative controls: the whole posterior bends the map, even from the truth, and matched peaks are less exact
    assert error(posterior, climb(posterior, truth, steps=8).params, truth) > 0.2
    monkeypatch.setattr(start, "settled", lambda posterior, params, steps: params)
    assert error(posterior, find_start(posterior).params, truth) > 1.5 * near

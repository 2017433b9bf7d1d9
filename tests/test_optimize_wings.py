"""Light of the sources outside their footprints is told from structure of the background."""

import re
from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray
from test_optimize_local_background import haunted

import bayesfred as bf
from bayesfred.commands import pipeline
from bayesfred.optimize import wings
from bayesfred.optimize.wings import wings_outside

SHARE, WIDTH = 0.07, 3.9  # of the light in a halo, and its width in pixels
LENS = bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
LEVEL, FLUX = 200.0, 1e5


def haloed(
    seed: int, share: float = SHARE, footprint: float = 6.0, flux: float = FLUX
) -> bf.Posterior:
    """81 stars of various fluxes, 22 pixels apart, each in a halo, with footprints around them."""
    return bf.follow_images(unfollowed(seed, share, footprint, flux))


def unfollowed(seed: int, share: float, footprint: float, flux: float) -> bf.Posterior:
    """The same before the footprints are around the images."""
    rng = np.random.default_rng(seed)
    grid = bf.SourceCatalog.grid(9, 22.0, flux)
    sources = replace(grid, flux=flux * rng.lognormal(0.0, 0.5, len(grid)))
    detector = bf.Detector((221, 221))
    mean = sum(
        part * bf.ForwardModel(detector, sources, psf, LENS).expected_counts([0.01, 0.0], 0.0)
        for part, psf in ((1.0 - share, bf.GaussianPSF(1.3)), (share, bf.GaussianPSF(WIDTH)))
    )
    model = bf.ForwardModel(detector, sources, bf.GaussianPSF(1.3), LENS)
    counts = rng.poisson(mean + LEVEL).astype(float)
    nuisances = bf.Nuisances("free", offset=True, footprint=footprint)
    return bf.Posterior(model, counts, nuisances=nuisances)


def found(posterior: bf.Posterior) -> wings.Wings | None:
    return wings_outside(posterior, bf.find_map(posterior).params)


def halo(radius: float | NDArray[np.float64], flux: float) -> float | NDArray[np.float64]:
    return SHARE * flux * np.exp(-0.5 * (radius / WIDTH) ** 2) / (2.0 * np.pi * WIDTH**2)


def test_wings_are_those_of_the_halo() -> None:
    """The counts in the first ring, and where the rest adds a standard deviation to the misfit."""
    for seed in (1, 2):
        posterior = haloed(seed)
        wing = found(posterior)
        assert wing is not None
        flux = posterior.model.sources.flux
        typical = float(np.mean(flux**2) ** 0.5)
        # of a core that takes what of the halo lies under it the flux is too large
        assert wing.counts == pytest.approx(halo(6.5, typical), rel=0.15)
        ring = wing.radius / wings.DARK + np.array([-1.5, 1.5])
        squares = halo(ring, typical) ** 2 * flux.size * 2.0 * np.pi * ring / LEVEL
        spread = (2.0 * posterior.mask.sum()) ** 0.5
        assert squares[0] > 0.5 * spread and squares[1] < 2.0 * spread
        assert 9.0 <= wing.radius <= 14.0
        assert f"footprint = {wing.radius:g}" in wing.remedy
        # nothing is left outside the footprints that it asks for
        assert found(haloed(seed, footprint=wing.radius)) is None


def test_no_wings_where_there_are_none() -> None:
    assert all(found(haloed(seed, 0.0)) is None for seed in range(3, 7))


def test_wings_that_no_fit_would_notice_are_not_told() -> None:
    """Though they are there, by 3 standard deviations of the misfit."""
    posterior = haloed(14, flux=1.9e4)
    assert found(posterior) is None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wings, "NOTICEABLE", 2.0)
        assert found(posterior) is not None


def test_a_line_before_the_fit_tells_of_them() -> None:
    for share, told in ((SHARE, True), (0.0, False)):
        _, _, lines = pipeline._follow(unfollowed(15, share, 6.0, FLUX), None, rough=False)
        assert any("light outside their footprints" in line for line in lines) == told
        assert not any(line.startswith("background: ") for line in lines)


def test_structure_of_the_background_is_no_wing() -> None:
    """Ghosts of five times the background, and the noise that they bring."""
    for seed in range(4):
        assert found(bf.follow_images(haunted(seed, 100.0))) is None


def test_other_stars_beside_some_sources_are_no_wings() -> None:
    """Stars as bright beside a sixth of them, within the first rings."""
    posterior = haloed(8, 0.0)
    s, rng = posterior.model.sources, np.random.default_rng(9)
    some = rng.choice(len(s), len(s) // 6, replace=False)
    angle = rng.uniform(0.0, 2.0 * np.pi, some.size)
    beside = bf.SourceCatalog(
        s.x[some] + 8.0 * np.cos(angle), s.y[some] + 8.0 * np.sin(angle), s.flux[some]
    )
    model = replace(posterior.model, sources=beside)
    counts = posterior.counts + bf.simulate(model, [0.01, 0.0], 0.0, seed=10)
    crowded = replace(posterior, counts=counts, extrapolation=None)
    assert found(crowded) is None
    # not left out, they are
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wings, "CLIP", np.inf)
        assert found(crowded) is not None


def test_nothing_is_told_where_nothing_is_seen() -> None:
    posterior = haloed(11)
    params = bf.find_map(posterior).params
    assert wings_outside(posterior, params) is not None
    assert wings_outside(replace(posterior, mask=posterior.valid), params) is None
    # of few sources each may have a neighbour
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wings, "FEWEST", 82)
        assert wings_outside(posterior, params) is None


@pytest.mark.slow
@pytest.mark.parametrize("flux", [1e5, 3e5, 1e6])
def test_the_verdict_names_them_and_the_remedy_cures(flux: float) -> None:
    """Also where they are so bright that more than background seems to be there."""

    def fitted(footprint: float) -> tuple[bf.Posterior, bf.MapEstimate]:
        posterior = haloed(12, footprint=footprint, flux=flux)
        return bf.measure_psf(posterior, bf.find_map(posterior))

    posterior, estimate = fitted(6.0)
    assert not estimate.fits_data
    cause = bf.find_causes(posterior, estimate.params)[0]
    assert cause.name == "wings" and "light outside their footprints" in cause.sentence
    radius = re.fullmatch(r"set nuisances.footprint = ([\d.]+)(, or more)?", cause.remedy)
    assert radius is not None and bool(radius[2]) == (flux > 1e5)
    # all of it, where there is more than can be seen
    assert fitted(float(radius[1]) if flux < 1e6 else 18.0)[1].fits_data


@pytest.mark.slow
def test_they_are_named_before_the_background_that_they_seem_to_be() -> None:
    """Each would explain more than the misfit."""
    posterior = haloed(12, footprint=9.0, flux=1e6)
    posterior, estimate = bf.measure_psf(posterior, bf.find_map(posterior))
    assert bf.find_causes(posterior, estimate.params)[0].name == "wings"


def test_faults_of_other_kinds_are_no_wings() -> None:
    for name in ("background", "PSF"):
        plant = next(plant for plant, names in planted.FAULTS.values() if name in names)
        posterior = plant(13)
        causes = bf.find_causes(posterior, bf.find_map(posterior).params)
        assert "wings" not in [cause.name for cause in causes]

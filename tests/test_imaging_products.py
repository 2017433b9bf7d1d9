"""Where maps are translations images are products: the same numbers as from the general loops."""

import numpy as np
import oracles
import pytest
from numba import types
from numpy.typing import NDArray

import bayesfred as bf
from bayesfred.imaging.kernels.products import _product_lines

Floats = NDArray[np.float64]

SOURCES = bf.SourceCatalog(
    [-12.3, -6.5, 11.8, 33.0], [-5.1, -2.0, 13.4, 4.0], [4e3, 900.0, 2e3, 3e3]
)
TERMS = bf.PolynomialDistortion.polynomial(3)
DETECTORS = {
    "impulse": bf.Detector((40, 60)),
    "box": bf.Detector((40, 60), pixel="box"),
    "binned": bf.Detector((20, 30), 2, "box"),
}
NUISANCES = {
    "scale": bf.Nuisances("scale", offset=True, psf_sigma=True, background_order=1),
    "free": bf.Nuisances("free", offset=True, psf_sigma=True),
    "scatter": bf.Nuisances("free", psf_sigma=True, position_scatter=True),
    "error": bf.Nuisances("free", psf_sigma=True, position_scatter=True, model_error=True),
}


def pair(detector: bf.Detector, nuisances: bf.Nuisances) -> tuple[bf.Posterior, bf.Posterior]:
    """A posterior and the same with a term in u, whose map is a translation only where it is 0."""
    general = bf.PolynomialDistortion([*TERMS.f_terms, (1, 0, 1, 0)], [*TERMS.g_terms])
    models = [bf.ForwardModel(detector, SOURCES, bf.GaussianPSF(1.3), d) for d in (TERMS, general)]
    counts = bf.simulate(models[0], np.zeros(TERMS.n_terms), 4.0, seed=3)
    one, other = (bf.Posterior(model, counts, nuisances=nuisances) for model in models)
    return one, other


def at(posterior: bf.Posterior) -> Floats:
    """Parameters some errors from where the frame was drawn."""
    params, extra = posterior.start(), "f_ux" in posterior.parameter_names
    rng = np.random.default_rng(8)
    names = [name for name in posterior.parameter_names if name != "f_ux"]
    values = dict(zip(posterior.parameter_names, params, strict=True))
    reach = TERMS.largest_displacement(30.0, 20.0).max(axis=0)
    for k, name in enumerate(names[: TERMS.n_terms]):
        values[name] = 0.3 * rng.standard_normal() / reach[k]
    values |= {"psf_sigma": 1.35, "background": 4.2}
    assert not extra or values["f_ux"] == 0.0
    return np.array([values[name] for name in posterior.parameter_names])


@pytest.mark.parametrize("detector", DETECTORS.values(), ids=DETECTORS)
def test_counts_are_those_of_the_dense_image(detector: bf.Detector) -> None:
    model = bf.ForwardModel(detector, SOURCES, bf.GaussianPSF(1.3), TERMS, tolerance=0.0)
    posterior, _ = pair(detector, NUISANCES["scale"])
    theta = at(posterior)[: TERMS.n_terms]
    sources = (SOURCES.x, SOURCES.y, SOURCES.flux)
    arguments = (TERMS.f_terms, TERMS.g_terms, theta, sources, 1.3, detector.shape)
    if detector.pixel == "box":
        expected = oracles.box_counts(*arguments, detector.binning, order=9)
    else:
        expected = oracles.impulse_counts(*arguments, detector.binning)
    # box pixels are integrated to 1e-8 of the peak, beyond it the same products
    assert model.expected_counts(theta) == pytest.approx(expected, abs=1e-7 * expected.max())


@pytest.mark.parametrize(
    "nuisances",
    [
        pytest.param(each, marks=pytest.mark.slow if name == "error" else (), id=name)  # to compile
        for name, each in NUISANCES.items()
    ],
)
@pytest.mark.parametrize("detector", DETECTORS.values(), ids=DETECTORS)
def test_derivatives_are_those_of_the_general_loops(
    detector: bf.Detector, nuisances: bf.Nuisances
) -> None:
    one, other = pair(detector, nuisances)
    x, y = at(one), at(other)
    shared = [i for i, name in enumerate(other.parameter_names) if name != "f_ux"]
    assert one.log_prob(x) == pytest.approx(
        other.log_prob(y) - other.log_prior(y)[0] + one.log_prior(x)[0], abs=1e-7
    )
    assert one.fluxes(x) == pytest.approx(other.fluxes(y), rel=1e-8)
    fisher = one.fisher(x)
    scale = 1.0 / np.sqrt(np.diag(fisher))
    found = (one.gradient(x) - one.prior_gradient(x)) * scale
    expected = (other.gradient(y) - other.prior_gradient(y))[shared] * scale
    assert found == pytest.approx(expected, abs=1e-7)
    assert np.abs(found).max() > 0.1  # negative control: there is something to compare
    both = np.outer(scale, scale)
    assert fisher * both == pytest.approx(other.fisher(y)[np.ix_(shared, shared)] * both, abs=1e-7)
    for mine, others in zip(
        one.likelihood.own_pixels(x, 3.0)[0], other.likelihood.own_pixels(y, 3.0)[0], strict=True
    ):
        assert np.asarray(mine) == pytest.approx(np.asarray(others), rel=1e-7, abs=1e-7)


def test_what_makes_products_is_compiled_only_for_them() -> None:
    """For no frame whose maps are more than translations, and for those that are (a control)."""
    for posterior in pair(DETECTORS["impulse"], NUISANCES["scale"]):
        posterior.fisher(at(posterior))
    kinds = [dict(zip(s[0].fields, s[0].types, strict=True)) for s in _product_lines.overloads]
    optics = [dict(zip(k["optics"].fields, k["optics"].types, strict=True)) for k in kinds]
    assert optics and all(o["translates"] == types.boolean for o in optics)

"""Frames that say more than their numbers are honoured or refused, never dropped."""

from typing import Any

import numpy as np
import pytest
from astropy import units
from astropy.nddata import CCDData, NDData, StdDevUncertainty, VarianceUncertainty
from astropy.utils.masked import Masked
from test_io_files import message

import bayesfred as bf

SHAPE = (65, 65)
MODEL = bf.ForwardModel(
    bf.Detector(SHAPE),
    bf.SourceCatalog.grid(3, 20.0, 1e4),
    bf.GaussianPSF(3.0),
    bf.PolynomialDistortion([(1, 0, 1, 0)], []),
)
COUNTS = bf.simulate(MODEL, [1e-4], 20.0, seed=1)
BAD = np.zeros(SHAPE, bool)
BAD[10:14, 20], BAD[40, 41] = True, True
SPOILT = np.where(BAD, -999.0, COUNTS)
SD = np.sqrt(COUNTS + 1.0)


@pytest.mark.parametrize(
    "frame",
    [
        np.ma.MaskedArray(SPOILT, BAD),
        CCDData(SPOILT, unit="electron", mask=BAD),
        CCDData(SPOILT / 1000.0, unit=1000.0 * units.electron, mask=BAD),
        NDData(SPOILT, mask=BAD),
        Masked(SPOILT * units.photon, BAD),
        Masked(SPOILT, BAD),
    ],
    ids=["masked array", "CCDData", "CCDData of thousands", "NDData", "masked quantity", "Masked"],
)
def test_masks_are_honoured(frame: Any) -> None:
    posterior = bf.Posterior(MODEL, frame)
    np.testing.assert_array_equal(posterior.mask, ~BAD)
    np.testing.assert_allclose(posterior.counts, np.where(BAD, 0.0, COUNTS), rtol=1e-15)
    plain = bf.Posterior(MODEL, COUNTS, mask=~BAD)
    params = np.array([1e-4, 20.0])
    assert posterior.log_prob(params) == pytest.approx(plain.log_prob(params), rel=1e-14)
    # with a mask of the caller's too, only pixels that both admit are used
    own = np.ones(SHAPE, bool)
    own[0] = False
    np.testing.assert_array_equal(bf.Posterior(MODEL, frame, mask=own).mask, own & ~BAD)


@pytest.mark.parametrize("unit", ["electron", "photon", "ct", "", "1000 electron"])
def test_units_that_are_counts(unit: str) -> None:
    frame = COUNTS * units.Unit(unit)
    posterior = bf.Posterior(MODEL, frame)
    scale = 1000.0 if "1000" in unit else 1.0
    np.testing.assert_array_equal(posterior.counts, scale * COUNTS)
    assert posterior.mask.all()


@pytest.mark.parametrize("unit", ["adu", "electron / s", "Jy", "DN"])
@pytest.mark.parametrize("kind", [units.Quantity, CCDData])
def test_other_units_are_refused(unit: str, kind: Any) -> None:
    text = message(bf.Posterior, MODEL, kind(COUNTS, unit=unit))
    assert text.startswith("counts: got a frame in ") and "gain" in text


@pytest.mark.parametrize(
    "uncertainty", [StdDevUncertainty(SD), VarianceUncertainty(SD**2)], ids=["sd", "variance"]
)
def test_uncertainties_are_those_of_the_noise_model(uncertainty: Any) -> None:
    frame = CCDData(COUNTS, unit="electron", uncertainty=uncertainty)
    assert bf.Posterior(MODEL, frame, noise=bf.GaussianNoise(SD**2)).mask.all()
    for noise in (bf.PoissonNoise(), bf.GaussianNoise(2.0 * SD**2), bf.GaussianNoise(9.0)):
        text = message(bf.Posterior, MODEL, frame, noise=noise)
        assert "got a frame with uncertainties" in text and "bf.GaussianNoise" in text
    frame.uncertainty = None
    assert bf.Posterior(MODEL, frame).mask.all()


def test_flags_and_shapes_are_refused() -> None:
    flagged = CCDData(COUNTS, unit="electron", flags=BAD.astype(int))
    assert "expected a mask" in message(bf.Posterior, MODEL, flagged)
    frame = np.ma.MaskedArray(COUNTS[:-1], BAD[:-1])
    assert "counts: got shape (64, 65)" in message(bf.Posterior, MODEL, frame)
    short = np.ones((3, 3), bool)
    masked = np.ma.MaskedArray(COUNTS, BAD)
    assert "mask: got shape (3, 3)" in message(bf.Posterior, MODEL, masked, mask=short)

"""Gain, read noise and pedestal from the noise of frames, beside the values they were made with."""

from typing import Any

import numpy as np
import pytest
from astropy import units
from astropy.nddata import CCDData
from numpy.typing import NDArray
from scipy import ndimage
from test_io_files import message

import bayesfred as bf

Floats = NDArray[np.float64]
GAIN, NOISE, PEDESTAL = 2.5, 8.0, 100.0
ZERO = PEDESTAL - NOISE**2 / GAIN


def scene(kind: str, n: int = 300) -> Floats:
    """Expected electrons: a gradient, or 200 stars of a width on a vignetted sky."""
    v, u = np.indices((n, n)) - n / 2
    if kind == "gradient":
        return np.asarray(1000.0 * (0.1 + 0.9 * (u + n / 2) / n))
    rng, light = np.random.default_rng(7), 300.0 * np.exp(-(u**2 + v**2) / (0.5 * n**2)) + 40.0
    s, flux = {"narrow": 0.7, "stars": 1.0, "wide": 4.0}[kind], rng.pareto(1.0, 200) * 2e3
    for x, y, f in zip(*rng.uniform(-n / 2, n / 2, (2, 200)), np.minimum(flux, 1e6), strict=True):
        square = (u - x) ** 2 + (v - y) ** 2
        light += f / (2 * np.pi * s**2) * np.exp(-square / (2 * s**2))
    return np.asarray(light)


def stored(light: Floats, rng: np.random.Generator, read_noise: float = NOISE) -> Floats:
    electrons = rng.poisson(light) + rng.normal(0.0, read_noise, light.shape)
    return np.asarray(np.floor(electrons / GAIN + PEDESTAL + 0.5))


def deviates(found: bf.PhotonTransfer) -> list[float]:
    return [
        (found.gain - GAIN) / found.gain_sd,
        (found.zero_level - ZERO) / found.zero_level_sd,
        (found.read_noise - NOISE) / found.read_noise_sd,
        (found.pedestal - PEDESTAL) / found.pedestal_sd,
    ]


@pytest.mark.parametrize("kind", ["gradient", "narrow", "stars", "wide"])
@pytest.mark.parametrize("number", [4, pytest.param(60, marks=pytest.mark.statistics)])
def test_values_are_found_to_within_their_errors(kind: str, number: int) -> None:
    light, rng = scene(kind), np.random.default_rng(1)
    one, two = [], []
    for _ in range(number):
        first, second = stored(light, rng), stored(light, rng)
        one.append(deviates(bf.photon_transfer(first)))
        two.append(deviates(bf.photon_transfer(first, second)))
    # means of normal deviates scatter by 1 / sqrt(number), standard deviations by 0.7 of that
    error = number**-0.5
    assert np.all(np.abs(np.mean(two, axis=0)) < 0.4 + 3.5 * error)
    assert np.all(np.sqrt(np.mean(np.square(two), axis=0)) < 1.25 + 2.5 * error)
    line = np.array(one)[:, :2]
    assert np.all(np.abs(np.mean(line, axis=0)) < 0.4 + 3.5 * error)
    assert np.all(np.sqrt(np.mean(np.square(line), axis=0)) < 1.25 + 2.5 * error)
    # one frame says of read noise and pedestal only between which bounds they are
    assert np.all(np.abs(np.array(one)[:, 2:]) < 1.75)


def test_errors_are_small_enough_to_be_of_use() -> None:
    light, rng = scene("gradient"), np.random.default_rng(2)
    found = bf.photon_transfer(stored(light, rng), stored(light, rng))
    assert found.gain_sd < 0.05 and found.zero_level_sd < 4.0 and found.pedestal_sd < 30.0
    assert bf.photon_transfer(stored(light, rng)).gain_sd < 0.1
    # negative control: noise that was smoothed is not that of photons
    smooth = ndimage.uniform_filter(stored(light, rng), 2)
    assert abs(deviates(bf.photon_transfer(smooth))[0]) > 20.0


def test_cosmic_rays_hot_pixels_and_moved_stars_do_not_count() -> None:
    light, rng = scene("stars"), np.random.default_rng(3)
    first, second = stored(light, rng), stored(np.roll(light, 1, axis=0), rng)
    hit = rng.random(light.shape) < 2e-3
    first[hit] += rng.exponential(3e3, light.shape)[hit]
    assert np.all(np.abs(deviates(bf.photon_transfer(first))[:2]) < 4.0)
    assert np.all(np.abs(deviates(bf.photon_transfer(first, second))[:2]) < 4.0)


def test_masks_units_and_saturated_pixels() -> None:
    light, rng = scene("gradient"), np.random.default_rng(4)
    image = stored(light, rng)
    plain = bf.photon_transfer(image)
    bad = np.zeros(light.shape, bool)
    bad[20:30, 20:30] = True
    spoilt = np.where(bad, 1e9, image)
    for frame in (
        np.ma.MaskedArray(spoilt, bad),
        CCDData(spoilt, unit="adu", mask=bad),
        np.where(bad, np.nan, image) * units.adu,
    ):
        found = bf.photon_transfer(frame)
        assert abs(found.gain - plain.gain) < plain.gain_sd
    full = bf.photon_transfer(np.minimum(image, 400.0))  # a fifth of the pixels
    assert abs(deviates(full)[0]) < 4.0


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        ((np.zeros((5, 5)),), "frame: got shape (5, 5), expected (ny, nx) of at least 32 pixels"),
        ((np.zeros(50),), "frame: got shape (50,)"),
        ((np.zeros((50, 50)), np.zeros((50, 51))), "second: got shape (50, 51)"),
        ((np.full((50, 50), np.nan),), "frame: got no pixels to use"),
        ((np.zeros((50, 50)),), "frame: got pixels that are all alike"),
        ((np.random.default_rng(1).normal(9, 1, (99, 99)),), "does not measurably grow"),
    ],
)
def test_frames_refused(frames: Any, said: str) -> None:
    assert said in message(bf.photon_transfer, *frames)

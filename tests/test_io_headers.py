"""Real frames: what headers, checksums, flags and plateaus say is honoured or refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy import units
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from test_io_files import message

from bayesfred.io.frames import read_frame
from bayesfred.io.saturation import plateau

ADU = np.random.default_rng(1).poisson(100.0, (20, 30)).astype(np.float64)


def frame(folder: Path, **cards: Any) -> Path:
    """A frame of 100 adu with these keywords."""
    header = fits.Header({key.replace("_", " "): value for key, value in cards.items()})
    path = folder / "frame.fits"
    fits.PrimaryHDU(ADU, header).writeto(path, overwrite=True)
    return path


@pytest.mark.parametrize(
    ("cards", "options", "gain", "said"),
    [
        ({"BUNIT": "adu", "GAIN": 2.5}, {}, 2.5, "gain 2.5 (GAIN)"),
        ({"GAIN": 2.5}, {}, 2.5, "gain 2.5 (GAIN)"),
        ({"BUNIT": "ADU", "GAIN": 120, "EGAIN": 0.8}, {}, 0.8, "gain 0.8 (EGAIN)"),
        ({"BUNIT": "adu", "GAIN": 2.5}, {"gain": 2.0}, 2.0, "2 as given, not GAIN = 2.5"),
        ({"BUNIT": "adu", "GAIN": "HIGH"}, {"gain": 2.0}, 2.0, "2 as given"),
        ({"BUNIT": "adu", "GAIN": 2.0}, {"gain": 2.0}, 2.0, "none masked"),
        ({"BUNIT": "electron", "GAIN": 2.5}, {}, 1.0, "in electron (BUNIT)"),
        ({"BUNIT": "ELECTRONS"}, {"gain": 1.0}, 1.0, "in ELECTRONS (BUNIT)"),
        ({"BUNIT": "adu/s"}, {"gain": 9.0}, 9.0, "BUNIT 'adu/s' converted by the gain given"),
        ({"BUNIT": "count"}, {}, 1.0, "none masked"),
        ({"BUNIT": "adu", "ESO_DET_OUT1_CONAD": 1.7}, {}, 1.7, "gain 1.7 (ESO DET OUT1 CONAD)"),
    ],
)
def test_units_and_gains(
    tmp_path: Path, cards: dict[str, Any], options: dict[str, float], gain: float, said: str
) -> None:
    if any("_" in key for key in cards):
        cards = {f"HIERARCH_{key}" if "_" in key else key: value for key, value in cards.items()}
    found = read_frame(frame(tmp_path, **cards), **options)
    np.testing.assert_allclose(found.counts, gain * ADU, rtol=1e-15)
    assert said in found.description


@pytest.mark.parametrize(
    ("cards", "options", "said"),
    [
        ({"BUNIT": "adu"}, {}, "BUNIT: got 'adu' without a GAIN, expected counts; give gain"),
        ({"BUNIT": "electron/s"}, {}, "BUNIT: got 'electron/s', expected adu or electrons"),
        ({"BUNIT": "MJy/sr", "GAIN": 2.0}, {}, "BUNIT: got 'MJy/sr'"),
        ({"BUNIT": "electron"}, {"gain": 2.0}, "gain: got 2.0 for a frame whose BUNIT"),
        ({"GAIN": 120}, {}, "GAIN: got 120 in the header, which looks like a camera's setting"),
        ({"GAIN": "HIGH"}, {}, "GAIN: got 'HIGH' in the header, expected a positive number"),
        ({"GAIN": 0}, {}, "GAIN: got '0' in the header, expected a positive number"),
        ({"GAIN": True}, {}, "GAIN: got 'True' in the header"),
        ({"PEDESTAL": 100}, {}, "PEDESTAL: got 100 in the header, of either sign"),
        ({"SATURATE": "none"}, {}, "SATURATE: got 'none' in the header, expected a number"),
    ],
)
def test_headers_refused(
    tmp_path: Path, cards: dict[str, Any], options: dict[str, float], said: str
) -> None:
    path = frame(tmp_path, **cards)
    text = message(read_frame, path, **options)
    assert text.startswith(f"{path}: ") and said in text


def test_pedestal_saturation_and_read_noise(tmp_path: Path) -> None:
    path = frame(tmp_path, PEDESTAL=-90, SATURATE=120.0, RDNOISE=3.5)
    found = read_frame(path, gain=2.0, pedestal=90.0)
    np.testing.assert_array_equal(found.valid, ADU < 120.0)
    np.testing.assert_array_equal(found.counts[found.valid], 2.0 * (ADU[found.valid] - 90.0))
    assert found.read_noise == 3.5 and "saturation 120 (SATURATE)" in found.description
    assert "pedestal" not in found.description  # what is given agrees, but for the sign
    other = read_frame(path, gain=2.0, pedestal=50.0, saturation=130.0)
    np.testing.assert_array_equal(other.valid, ADU < 130.0)
    assert "pedestal 50 as given, not PEDESTAL = -90" in other.description
    assert "130 as given, not SATURATE = 120" in other.description
    bad = read_frame(frame(tmp_path, RDNOISE="low"))
    assert bad.read_noise is None and "RDNOISE = nan not used" in bad.description


def test_keywords_of_the_file_count_for_its_images(tmp_path: Path) -> None:
    primary = fits.PrimaryHDU(header=fits.Header({"GAIN": 2.0, "RDNOISE": 5.0}))
    image = fits.ImageHDU(ADU, fits.Header({"BUNIT": "adu", "RDNOISE": 4.0}), name="SCI")
    fits.HDUList([primary, image]).writeto(tmp_path / "frame.fits")
    found = read_frame(tmp_path / "frame.fits")
    np.testing.assert_array_equal(found.counts, 2.0 * ADU)
    assert found.read_noise == 4.0


@pytest.mark.parametrize("suffix", [".fits", ".fits.gz", ".fits.fz"])
@pytest.mark.parametrize("damage", ["none", "data", "header"])
def test_checksums(tmp_path: Path, suffix: str, damage: str) -> None:
    """One bit of the pixels, or a keyword, was changed after the file was written."""
    image = np.arange(400.0).reshape(20, 20)
    path = tmp_path / "frame.fits"
    if suffix == ".fits.fz":
        packed = fits.CompImageHDU(image, compression_type="GZIP_2", quantize_level=0.0)
        fits.HDUList([fits.PrimaryHDU(), packed]).writeto(path, checksum=True)
    else:
        fits.PrimaryHDU(image).writeto(path, checksum=True)
    content = bytearray(path.read_bytes())
    if damage == "data":
        content[content.rindex(b"END" + b" " * 77) // 2880 * 2880 + 2880 + 9] ^= 1
    elif damage == "header":
        where = content.index(b"conforms to FITS")
        content[where : where + 8] = b"CONFORMS"
    path = tmp_path / f"frame{suffix}"
    if suffix == ".fits.gz":
        import gzip

        path.write_bytes(gzip.compress(bytes(content)))
    else:
        path.write_bytes(bytes(content))
    if damage == "none":
        np.testing.assert_array_equal(read_frame(path).counts, image)
        return
    text = message(read_frame, path)
    assert text.startswith(f"{path}: CHECKSUM: got a wrong one")
    assert "get it again" in text


def with_flags(folder: Path, flags: Any, name: str = "DQ", **options: Any) -> Path:
    path = folder / "frame.fits"
    extension = fits.ImageHDU(np.asarray(flags), name=name, **options)
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(ADU, name="SCI"), extension]).writeto(
        path, overwrite=True
    )
    return path


@pytest.mark.parametrize("name", ["DQ", "MASK", "BPM"])
def test_flagged_pixels_are_masked(tmp_path: Path, name: str) -> None:
    flags = np.zeros(ADU.shape, np.int16)
    flags[3, 4], flags[5, :2] = 1, 4096
    found = read_frame(with_flags(tmp_path, flags, name))
    np.testing.assert_array_equal(found.valid, flags == 0)
    assert f"3 masked (3 flagged in {name})" in found.description
    # flags of another image of the file are not this one's
    assert read_frame(with_flags(tmp_path, flags, name, ver=2)).valid.all()


def test_flags_refused(tmp_path: Path) -> None:
    text = message(read_frame, with_flags(tmp_path, np.zeros((4, 5), np.uint8)))
    assert "DQ: got an extension of 4 x 5, expected the frame's 20 x 30 pixels" in text
    good = np.ones(ADU.shape, np.uint8)  # one where a pixel is good
    good[0, 0] = 0
    text = message(read_frame, with_flags(tmp_path, good))
    assert "DQ: got 100% of the pixels flagged, expected zero where a pixel is good" in text


def test_a_file_that_ccddata_wrote(tmp_path: Path) -> None:
    mask = np.zeros(ADU.shape, bool)
    mask[2, 3] = True
    ccd = CCDData(ADU, unit=units.electron, mask=mask, uncertainty=StdDevUncertainty(ADU**0.5))
    ccd.write(tmp_path / "frame.fits")
    found = read_frame(tmp_path / "frame.fits")
    np.testing.assert_array_equal(found.valid, ~mask)
    assert "UNCERT not used" in found.description and "electron (BUNIT)" in found.description


# Saturation


def stars(seed: int, gain: float = 2.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A frame of 60 stars of all brightnesses, in adu as integers."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(200.0), np.arange(200.0))
    light = np.full(u.shape, 100.0)
    for x, y, flux in zip(*rng.uniform(0, 200, (2, 60)), rng.pareto(1.0, 60) * 1e4, strict=True):
        light += flux / (8 * np.pi) * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8.0)
    return np.asarray(np.floor(rng.poisson(light) / gain))


def test_plateaus_are_suspected_and_nothing_else() -> None:
    frames = [stars(seed) for seed in range(200)]
    found = [plateau(image.ravel()) for image in frames]
    assert sum(level is not None for level in found) <= 2  # 200 frames of a chance below 0.001
    clipped = [np.minimum(image, 0.5 * image.max()) for image in frames]
    seen = [plateau(image.ravel()) == image.max() for image in clipped]
    several = [np.sum(image == image.max()) >= 3 for image in clipped]
    assert np.mean(np.array(seen)[several]) > 0.9 and sum(several) > 100
    # full scale needs no company
    one = frames[0].copy()
    one[50, 50] = 65535
    assert plateau(one.ravel()) == 65535.0
    # neither numbers far apart, nor a frame without light, nor one of a few counts, where ties are
    # the rule
    assert plateau(np.array([0.0, 5e-324, 1.0, 2.0])) is None
    assert plateau(np.array([-1.7e308, 0.0, 1.0, 1.7e308])) is None
    assert plateau(np.zeros(100)) is None and plateau(np.zeros(0)) is None
    assert plateau(np.random.default_rng(1).poisson(0.1, 10**5).astype(float)) is None


def test_suspected_pixels_are_masked_unless_told_otherwise(tmp_path: Path) -> None:
    image = np.minimum(stars(3), 1000.0)
    np.save(tmp_path / "frame.npy", image)
    found = read_frame(tmp_path / "frame.npy")
    np.testing.assert_array_equal(found.valid, image < 1000.0)
    assert "suspected of saturation" in found.description
    assert "give a higher saturation if that is wrong" in found.description
    assert read_frame(tmp_path / "frame.npy", saturation=1001.0).valid.all()

"""From a frame and RA/Dec to a calibration and other tools' formats, by commands alone."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from test_cli import Output, assert_refused, invoke, snapshot

import bayesfred as bf
from bayesfred.io.frames import write_frame
from bayesfred.io.tangent_plane import TangentPlane

SHAPE = (180, 240)
PLANE = TangentPlane(201.3, 47.2, ((-0.005, 0.0087), (0.0087, 0.005)))
LENS = bf.PolynomialDistortion([(1, 0, 0, 0), (3, 0, 0, 0), (1, 2, 0, 0)],
                               [(0, 1, 0, 0), (2, 1, 0, 0), (0, 3, 0, 0)])  # fmt: skip
THETA = np.array([0.002, -1e-6, -1e-6, 0.002, -1e-6, -1e-6])
RUN = """
[frame]
path = "night.fits"
[catalogue]
path = "stars.csv"
ra = "RA"
dec = "Dec"
flux = "counts"
[sky]
pointing = [201.9, 46.8]
pixel_scale = 35.0
[psf]
sigma = 1.5
[distortion]
terms = "polynomial"
degree = 3
[nuisances]
flux = "free"
offset = true
[output]
path = "night.h5"
"""


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Output]:
    """A frame of 60 stars, a catalogue with sexagesimal RA, and the fit of both."""
    folder = tmp_path_factory.mktemp("night")
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-170.0, 170.0, 160), rng.uniform(-140.0, 140.0, 160)
    flux = 2000.0 * (1.0 + rng.pareto(1.5, 160))
    model = bf.ForwardModel(
        bf.Detector(SHAPE), bf.SourceCatalog(x, y, flux), bf.GaussianPSF(1.5), LENS
    )
    write_frame(folder / "night.fits", bf.simulate(model, THETA, 5.0, seed=6))
    stars = SkyCoord(*PLANE.to_sky(x, y), unit="deg")
    hours = stars.ra.to_string(unit="hourangle", sep=":", precision=7)
    rows = (f"{h},{d:.9f},{f:.1f}" for h, d, f in zip(hours, stars.dec.deg, flux, strict=True))
    (folder / "stars.csv").write_text("RA,Dec,counts\n" + "\n".join(rows) + "\n")
    (folder / "night.toml").write_text(RUN)
    return folder, invoke(folder, "fit", "night.toml", "--map-only")


def copied(night: tuple[Path, Output], to: Path) -> Path:
    return shutil.copytree(night[0], to / "night")


def test_the_pose_and_the_lens_are_found(night: tuple[Path, Output]) -> None:
    folder, output = night
    assert output.code == 0, output.stderr
    assert "pose: " in output.stdout
    assert "arcsec per pixel, position angle" in output.stdout
    chain = bf.open_chain(folder / "night.h5")
    sky = chain.posterior().model.sources.sky
    assert sky.pixel_scale == pytest.approx(PLANE.pixel_scale, rel=0.01)
    names = ("f_x3", "f_xy2", "g_x2y", "g_y3")
    cubic = chain.draws()[:, [chain.parameter_names.index(name) for name in names]]
    z = (cubic.mean(axis=0) - THETA[[1, 2, 4, 5]]) / cubic.std(axis=0)
    assert np.abs(z).max() < 4.0


def test_its_own_file_maps_and_picture(night: tuple[Path, Output], tmp_path: Path) -> None:
    folder = copied(night, tmp_path)
    done = invoke(folder, "calibration", "night.h5")
    assert done.code == 0, done.stderr
    assert done.stdout.splitlines()[-1].startswith("trustworthy: The model fits the counts")
    known = bf.Calibration.read(folder / "night.calibration.h5")
    u = np.array([-80.0, 0.0, 80.0])
    at, covariance = known.to_sky(u, 0.6 * u)
    x, y = LENS.object_position(THETA, u, 0.6 * u)
    truth = SkyCoord(*PLANE.to_sky(x, y), unit="deg")
    off = np.stack([part.arcsec for part in truth.spherical_offsets_to(at)], axis=1)
    square = [d @ np.linalg.solve(c, d) for d, c in zip(off, covariance, strict=True)]
    assert max(square) < 25.0
    assert np.sqrt(covariance[1, 0, 0]) < 1.5  # arcsec, of 36 a pixel
    with fits.open(folder / "night.calibration.fits") as maps:
        assert maps["SD_U"].data.shape == maps["FWHM"].data.shape
    assert (folder / "night.calibration.png").read_bytes()[:4] == b"\x89PNG"
    before = snapshot(folder)
    assert_refused(invoke(folder, "calibration", "night.h5"), "exists, expected a new file")
    assert snapshot(folder) == before


@pytest.mark.parametrize(("form", "degree"), [("--sip", "3"), ("--tpv", "3")])
def test_headers(night: tuple[Path, Output], tmp_path: Path, form: str, degree: str) -> None:
    folder = copied(night, tmp_path)
    done = invoke(folder, "calibration", "night.h5", form, degree, "--out", "header.fits")
    assert done.code == 0, done.stderr
    assert "truncation error of pixel to sky: " in done.stdout
    header = fits.getheader(folder / "header.fits")
    header["NAXIS"] = 2
    header["NAXIS1"], header["NAXIS2"] = SHAPE[::-1]
    known = bf.Calibration.from_chain(bf.open_chain(folder / "night.h5"))
    u, v = np.array([-90.0, 80.0, 10.0]), np.array([60.0, 70.0, -50.0])
    by_header = WCS(header).pixel_to_world(*known.index(u, v))
    off = by_header.separation(known.to_sky(u, v)[0]).arcsec / known.sky.pixel_scale
    assert off.max() <= 1.01 * header["BFFWDMAX"] < 0.03


def test_other_formats(night: tuple[Path, Output], tmp_path: Path) -> None:
    folder = copied(night, tmp_path)
    assert invoke(folder, "calibration", "night.h5", "--opencv").code == 0
    camera = json.loads((folder / "night.json").read_text())
    assert "camera_matrix" in camera
    assert invoke(folder, "calibration", "night.h5", "--regions").code == 0
    assert "vector(" in (folder / "night.reg").read_text()
    assert_refused(
        invoke(folder, "calibration", "night.h5", "--sip", "3", "--opencv"),
        "got --sip and --opencv, expected one format a call",
    )
    assert_refused(
        invoke(folder, "calibration", "night.h5", "--sip", "3", "--out", "header.txt"),
        "header.txt: got a file ending in '.txt', expected .fits",
    )
    assert_refused(invoke(folder, "calibration", "night.h5", "--sip", "1"), "expected")
    assert_refused(invoke(folder, "calibration", "night.h5", "--out", "night.h5"), "is read")


def test_a_corrected_frame(night: tuple[Path, Output], tmp_path: Path) -> None:
    folder = copied(night, tmp_path)
    assert invoke(folder, "calibration", "night.h5").code == 0
    done = invoke(folder, "correct", "night.fits", "night.calibration.h5", "--out", "flat.fits")
    assert done.code == 0, done.stderr
    with fits.open(folder / "flat.fits") as hdus, fits.open(folder / "night.fits") as raw:
        counts = next(hdu.data for hdu in hdus if hdu.data is not None)
        assert np.nansum(counts) == pytest.approx(raw[0].data.sum(), rel=1e-6)
    assert_refused(
        invoke(folder, "correct", "night.fits", "night.calibration.h5", "--out", "night.fits",
               "--overwrite"), "got a file that is read, expected another to write",
    )  # fmt: skip
    assert_refused(
        invoke(folder, "correct", "night.fits", "night.h5", "--out", "other.fits"),
        "expected bayesfred calibration of schema",
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("pointing = [201.9, 46.8]", "pointing = [205.9, 46.8]"), "sky: got no pose within 1 deg"),
        (("pixel_scale = 35.0", ""), "sky: got pointing alone, expected pointing and pixel_scale"),
        (('ra = "RA"', 'ra = "R.A."'), "got no column 'R.A.', expected one of: 'RA', 'Dec'"),
        (('ra = "RA"', 'ra = "Dec"'), "no pose"),
        (('dec = "Dec"', ""), "catalogue: got ra alone, expected ra and dec together"),
        (('ra = "RA"', 'x = "RA"\nra = "RA"'), "got x or y, expected them without ra and dec only"),
        (("[sky]\npointing = [201.9, 46.8]\npixel_scale = 35.0", ""),
         "sky: got neither a pointing nor a coordinate system in the frame's header"),
        (('path = "stars.csv"', 'path = "stars.csv"\npm_ra = "Dec"\npm_dec = "Dec"'),
         "got proper motions without epoch, expected it: 2016.0 for Gaia DR3"),
        (('path = "stars.csv"',
          'path = "stars.csv"\nepoch = 2016.0\npm_ra = "Dec"\npm_dec = "Dec"'),
         "got proper motions, expected the date of the frame too"),
        (('path = "stars.csv"', ""), "got neither path nor grid, expected one of them"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line(
    night: tuple[Path, Output], tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    folder = copied(night, tmp_path)
    (folder / "night.h5").unlink()
    before = change[0]
    assert before in RUN
    (folder / "night.toml").write_text(RUN.replace(*change))
    output = invoke(folder, "fit", "night.toml", "--map-only", "--overwrite")
    assert_refused(output, message)

"""Exports of a calibration: read by other programs, they say what the calibration says."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from numpy.typing import NDArray

import bayesfred as bf
from bayesfred.calibration.generalized_wcs import generalized_wcs
from bayesfred.calibration.opencv import NAMES, opencv_camera, write_opencv
from bayesfred.calibration.plate import fit_plate
from bayesfred.calibration.regions import residual_regions, write_regions
from bayesfred.calibration.wcs import HeaderExport, sip, tpv
from bayesfred.errors import InputError
from bayesfred.io.tangent_plane import TangentPlane

Floats = NDArray[np.float64]

# astropy says so of every header without an image, those of astrometry.net among them
pytestmark = pytest.mark.filterwarnings("ignore:The WCS transformation has more axes")

PLANES = {
    "sky": TangentPlane(83.0, -35.0, ((-0.004, 0.001), (0.0011, 0.0041)), (13.0, -7.0)),
    "mirrored": TangentPlane(359.9, 80.0, ((0.004, 0.001), (-0.0012, 0.0041)), (-20.0, 9.0)),
}
SIMILAR = {  # pixels that are square: what OpenCV can say
    "sky": TangentPlane(83.0, -35.0, ((-0.04, 0.01), (0.01, 0.04)), (13.0, -7.0)),
    "mirrored": TangentPlane(359.9, 80.0, ((0.04, 0.01), (-0.01, 0.04)), (-20.0, 9.0)),
}
LINEAR = [(1, 0, 0, 0), (0, 1, 0, 0)]
FIELD = bf.PolynomialDistortion(  # no symmetry, and images that do not follow from x and y alone
    [*LINEAR, (2, 0, 0, 0), (0, 2, 0, 0), (3, 0, 0, 0), (1, 2, 0, 0), (1, 0, 1, 0)],
    [*LINEAR, (2, 0, 0, 0), (1, 1, 0, 0), (0, 3, 0, 0), (2, 1, 0, 0), (0, 1, 0, 2)],
)
THETA = np.array(
    [3e-3, -2e-3, 1e-5, -8e-6, 4e-8, 3e-8, 6e-6, 1e-3, 5e-3, 7e-6, 9e-6, -5e-8, 2e-8, 3e-8]
)
OFFSET = np.array([1.3, -2.4])
CONVENTIONS = {"SIP": sip, "TPV": tpv}


def made(
    plane: TangentPlane | None = PLANES["sky"],
    *,
    n: int = 20,
    shape: tuple[int, int] = (200, 310),
    binning: int = 2,
    distortion: bf.PolynomialDistortion = FIELD,
    theta: Floats = THETA,
    spread: float = 0.01,
    **options: Any,
) -> bf.Calibration:
    """Of a frame without symmetry; sources beyond its edges, so that nothing is extrapolated."""
    rng = np.random.default_rng(5)
    middle = np.concatenate([theta, OFFSET])
    draws = middle * (1.0 + spread * rng.normal(size=(n, middle.size)))
    hull = 600.0 * np.array([(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)])
    detector = bf.Detector(shape, binning=binning)
    return bf.Calibration(
        distortion, draws, detector, bf.GaussianPSF(2.0), 2.0, hull, plane, **options
    )


def some_pixels(calibration: bf.Calibration, n: int = 500) -> Floats:
    """Array indices, column and row, all over the frame."""
    rows, columns = calibration.detector.shape
    return np.random.default_rng(3).uniform(-0.5, [[columns - 0.5], [rows - 0.5]], (2, n))


def distances(calibration: bf.Calibration, ra: Floats, dec: Floats, index: Floats) -> Floats:
    """Recorded pixels between directions and those in which the calibration has pixels point."""
    expected, _ = calibration.to_sky(*calibration.from_index(*index))
    assert calibration.sky is not None
    scale = calibration.sky.pixel_scale * calibration.detector.binning
    return np.asarray(expected.separation(SkyCoord(ra, dec, unit="deg")).arcsec / scale)


def reread(export: HeaderExport, tmp_path: Path) -> tuple[fits.Header, Table]:
    """Header and draws of the file that is written."""
    path = tmp_path / "header.fits"
    export.write(path)
    with fits.open(path, checksum=True) as file:
        return file[0].header.copy(), Table(file["DRAWS"].data)


# The conventions as they are printed: powers of x and y by number, of the radius none.
PV = {
    0: (0, 0), 1: (1, 0), 2: (0, 1), 4: (2, 0), 5: (1, 1), 6: (0, 2), 7: (3, 0), 8: (2, 1),
    9: (1, 2), 10: (0, 3), 12: (4, 0), 13: (3, 1), 14: (2, 2), 15: (1, 3), 16: (0, 4),
    17: (5, 0), 18: (4, 1), 19: (3, 2), 20: (2, 3), 21: (1, 4), 22: (0, 5), 24: (6, 0),
    25: (5, 1), 26: (4, 2), 27: (3, 3), 28: (2, 4), 29: (1, 5), 30: (0, 6), 31: (7, 0),
    32: (6, 1), 33: (5, 2), 34: (4, 3), 35: (3, 4), 36: (2, 5), 37: (1, 6), 38: (0, 7),
}  # fmt: skip


def naive_plane(header: fits.Header, pixel: Floats, *, swap: bool = True) -> Floats:
    """xi and eta of FITS pixels, one keyword after the other."""
    h, k = pixel[0] - header["CRPIX1"], pixel[1] - header["CRPIX2"]
    if header["CTYPE1"] == "RA---TAN-SIP":
        a, b = np.array(h), np.array(k)
        for key, value in header.items():
            if found := re.fullmatch(r"([AB])_(\d)_(\d)", key):
                term = value * h ** int(found[2]) * k ** int(found[3])
                a, b = (a + term, b) if found[1] == "A" else (a, b + term)
        h, k = a, b
    x = header["CD1_1"] * h + header["CD1_2"] * k
    y = header["CD2_1"] * h + header["CD2_2"] * k
    if header["CTYPE1"] == "RA---TAN-SIP":
        return np.array([x, y])
    xi, eta = np.zeros_like(x), np.zeros_like(x)
    for key, value in header.items():
        if found := re.fullmatch(r"PV([12])_(\d+)", key):
            i, j = PV[int(found[2])]
            if found[1] == "1":
                xi += value * x**i * y**j
            else:
                eta += value * (y**i * x**j if swap else x**i * y**j)
    return np.array([xi, eta])


def naive_pixel(header: fits.Header, plane: Floats) -> Floats:
    """FITS pixels by AP and BP."""
    cd = np.array([[header[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)])
    u, v = np.linalg.solve(cd, plane)
    h, k = np.array(u), np.array(v)
    for key, value in header.items():
        if found := re.fullmatch(r"([AB])P_(\d)_(\d)", key):
            term = value * u ** int(found[2]) * v ** int(found[3])
            h, k = (h + term, k) if found[1] == "A" else (h, k + term)
    return np.array([h + header["CRPIX1"], k + header["CRPIX2"]])


def true_plane(calibration: bf.Calibration, index: Floats) -> Floats:
    """xi and eta of the calibration, degree."""
    sky = calibration.sky
    assert sky is not None
    x, y, _ = calibration.to_object(*calibration.from_index(*index))
    return np.array(sky.matrix) @ np.array([x - sky.origin[0], y - sky.origin[1]])


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("parity", PLANES)
@pytest.mark.parametrize("binning", [1, 2])
def test_headers_point_where_the_calibration_does(
    convention: str, parity: str, binning: int, tmp_path: Path
) -> None:
    calibration = made(PLANES[parity], binning=binning, shape=(400 // binning, 620 // binning))
    export = CONVENTIONS[convention](calibration, 4)
    header, _ = reread(export, tmp_path)
    wcs, index = WCS(header), some_pixels(calibration)
    limit = 1.05 * header["BFFWDMAX"] + 1e-9
    assert 1e-6 < limit < 0.05
    assert distances(calibration, *wcs.all_pix2world(*index, 0), index).max() < limit
    assert distances(calibration, *wcs.all_pix2world(*(index + 1.0), 1), index).max() < limit
    at = wcs.pixel_to_world(*index)
    assert distances(calibration, at.ra.deg, at.dec.deg, index).max() < limit
    # a wrong origin is seen, whichever way it is wrong
    for wrong in (wcs.all_pix2world(*index, 1), wcs.all_pix2world(*(index + 1.0), 0)):
        assert distances(calibration, *wrong, index).min() > 1.0 > 20.0 * limit
    # and so are the two axes exchanged
    assert distances(calibration, *wcs.all_pix2world(*index[::-1], 0), index).max() > 10.0


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_headers_keep_to_the_text_of_the_convention(convention: str, tmp_path: Path) -> None:
    calibration = made()
    header, _ = reread(CONVENTIONS[convention](calibration, 7), tmp_path)
    index = some_pixels(calibration)
    plane = true_plane(calibration, index)
    assert calibration.sky is not None
    pixel = 2.0 * calibration.sky.pixel_scale / 3600.0
    assert np.abs(naive_plane(header, index + 1.0) - plane).max() < 1e-5 * pixel
    if convention == "SIP":
        assert np.abs(naive_pixel(header, plane) - index - 1.0).max() < 1e-5
        assert np.abs(naive_pixel(header, plane) - index).min() > 0.9
    else:  # a reader that overlooks that PV2 counts the axes the other way round
        wrong = naive_plane(header, index + 1.0, swap=False)
        assert np.abs(wrong - plane).max() > 1.0 * pixel


@pytest.mark.parametrize("shape", [(200, 310), (1, 300)])
def test_both_conventions_have_the_same_polynomials(shape: tuple[int, int]) -> None:
    calibration = made(shape=shape)
    for degree in (2, 3, 5):
        errors = [export(calibration, degree).forward for export in CONVENTIONS.values()]
        assert errors[0].rms == pytest.approx(errors[1].rms, rel=1e-4, abs=1e-9)
        assert errors[0].largest == pytest.approx(errors[1].largest, rel=1e-4, abs=1e-9)


def test_stated_errors_are_those_that_are_measured(tmp_path: Path) -> None:
    calibration = made()
    index = some_pixels(calibration, 20_000)
    plane = true_plane(calibration, index)
    assert calibration.sky is not None
    matrix = calibration.detector.binning * np.array(calibration.sky.matrix)
    for degree in (2, 3, 5):
        export = sip(calibration, degree)
        folder = tmp_path / f"{degree}"
        folder.mkdir()
        header, _ = reread(export, folder)
        forward = np.hypot(*np.linalg.solve(matrix, naive_plane(header, index + 1.0) - plane))
        back = np.hypot(*(naive_pixel(header, plane) - index - 1.0))
        for error, stated, keys in (
            (forward, export.forward, ("BFFWDRMS", "BFFWDMAX")),
            (back, export.inverse, ("BFINVRMS", "BFINVMAX")),
        ):
            assert 0.6 * stated.largest < error.max() < 1.02 * stated.largest
            assert np.sqrt(np.mean(error**2)) == pytest.approx(stated.rms, rel=0.15)
            assert [header[key] for key in keys] == pytest.approx(
                [stated.rms, stated.largest], rel=6e-3
            )
        assert export.inverse.largest < 1.5 * export.forward.largest


def test_higher_degrees_have_smaller_errors() -> None:
    calibration = made()
    errors = [sip(calibration, degree).forward.rms for degree in (2, 3, 4, 6, 8)]
    assert all(high < 0.7 * low for low, high in pairwise(errors)), errors
    assert tpv(calibration, 1).forward.rms > 2.0 * errors[0]


CUBE = np.array([1.0, -3.0, 3.0, -1.0])  # (x - y)^3, along x = y: its own inverse but for the sign
SLANT = bf.PolynomialDistortion(*[[(3, 0, 0, 0), (2, 1, 0, 0), (1, 2, 0, 0), (0, 3, 0, 0)]] * 2)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_a_cubic_is_exact(convention: str) -> None:
    calibration = made(distortion=SLANT, theta=4e-8 * np.tile(CUBE, 2), spread=0.0)
    export = CONVENTIONS[convention](calibration, 3)
    assert max(export.forward.largest, export.inverse.largest) < 1e-7
    coarse = CONVENTIONS[convention](calibration, 2)
    assert min(coarse.forward.largest, coarse.inverse.rms) > (1e-2 if convention == "TPV" else 0.0)
    assert coarse.forward.largest > 1e-2
    if convention == "SIP":
        assert export.header["AP_ORDER"] == 3


def sky_covariances(
    calibration: bf.Calibration, header: fits.Header, draws: Table, index: Floats
) -> Floats:
    """Covariance along east and north, arcsec^2, of where the draws of a header point."""
    assert calibration.sky is not None
    middle = calibration.to_sky(*calibration.from_index(*index))[0]
    steps = np.empty((len(draws), 2, index.shape[1]))
    for step, row in zip(steps, draws, strict=True):
        one = header.copy()
        one.update({name: float(row[name]) for name in draws.colnames})
        at = SkyCoord(*WCS(one).all_pix2world(*index, 0), unit="deg")
        step[:] = [d.arcsec for d in middle.spherical_offsets_to(at)]
    off = steps - steps.mean(axis=0)
    return np.einsum("nip,njp->pij", off, off) / (len(draws) - 1)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_draws_have_the_covariance_of_the_calibration(convention: str, tmp_path: Path) -> None:
    calibration = made(n=60)
    header, draws = reread(CONVENTIONS[convention](calibration, 5), tmp_path)
    rows, columns = calibration.detector.shape
    index = np.array([[0.0, columns - 1.0, 40.0, 200.0], [0.0, 20.0, rows - 1.0, 100.0]])
    _, expected = calibration.to_sky(*calibration.from_index(*index), method="draws")
    size = np.trace(expected, axis1=1, axis2=2)[:, None, None]
    found = sky_covariances(calibration, header, draws, index)
    assert np.abs((found - expected) / size).max() < 5e-3
    # draws whose coefficients do not belong together are seen
    shuffled = draws.copy()
    for name in ("CRPIX1", "CRPIX2"):
        shuffled[name] = shuffled[name][::-1]
    wrong = sky_covariances(calibration, header, shuffled, index)
    assert np.abs((wrong - expected) / size).max() > 0.05


def test_draws_of_the_inverse_are_inverses(tmp_path: Path) -> None:
    calibration = made()
    header, draws = reread(sip(calibration, 6), tmp_path)
    index = some_pixels(calibration, 50)
    for row in draws[:5]:
        header.update({name: float(row[name]) for name in draws.colnames})
        there = naive_plane(header, index + 1.0)
        assert np.abs(naive_pixel(header, there) - index - 1.0).max() < 1e-4
    assert len({row["AP_2_0"] for row in draws}) == len(draws)


def test_the_reference_pixel_may_be_beyond_the_frame() -> None:
    far = TangentPlane(83.0, -35.0, ((-0.004, 0.001), (0.0011, 0.0041)), (700.0, 100.0))
    calibration = made(far)
    export = sip(calibration, 4)
    assert export.header["CRPIX1"] > 400.0
    index = some_pixels(calibration)
    found = export.wcs.all_pix2world(*index, 0)
    assert distances(calibration, *found, index).max() < 1.05 * export.forward.largest + 1e-9
    assert export.inverse.largest < 0.01


def test_astropy_knows_the_frame() -> None:
    wcs = sip(made(), 3).wcs
    assert wcs.array_shape == (200, 310)
    assert wcs.celestial.wcs.radesys == "ICRS"


def test_headers_say_what_was_calibrated(tmp_path: Path) -> None:
    calibration = made(title="Kamera Süd\n2", message="not trustworthy: " + 40 * "word ")
    header, _ = reread(sip(calibration, 2), tmp_path)
    text = " ".join(str(header["COMMENT"]).split())
    assert r"Kamera S\xfcd\n2" in text
    assert " ".join((40 * "word ").split()) in text


def test_bad_input_is_refused(tmp_path: Path) -> None:
    calibration = made()
    for degree in (1, 10, 2.5, "3"):
        with pytest.raises(InputError, match=r"degree: got .* from 2 to 9"):
            sip(calibration, degree)
    for degree in (0, 8):
        with pytest.raises(InputError, match=r"degree: got .* from 1 to 7"):
            tpv(calibration, degree)
    for export in (sip, tpv, generalized_wcs):
        with pytest.raises(InputError, match="no place on the sky"):
            export(made(None))
    folding = bf.PolynomialDistortion([(3, 0, 0, 0)], [])
    with pytest.raises(InputError, match=r"no object to \d+ of"):
        sip(made(distortion=folding, theta=np.array([6e-6])))
    away = TangentPlane(83.0, -35.0, ((-0.004, 0.001), (0.0011, 0.0041)), (9e4, 0.0))
    with pytest.raises(InputError, match="touches the sky"):
        sip(made(away))
    path = tmp_path / "there.fits"
    path.touch()
    with pytest.raises(InputError, match="exists"):
        sip(calibration, 2).write(path)
    sip(calibration, 2).write(path, overwrite=True)
    assert fits.getheader(path)["A_ORDER"] == 2


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("program", ["wcsware", "xy2sky"])
def test_other_readers_agree(convention: str, program: str, tmp_path: Path) -> None:
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed")
    calibration = made()
    export = CONVENTIONS[convention](calibration, 4)
    path = tmp_path / "header.fits"
    export.write(path)
    index = some_pixels(calibration, 12)
    pairs = [(repr(float(p)), repr(float(q))) for p, q in (index + 1.0).T]
    if program == "wcsware":
        lines = "".join(f"{p} {q}\n" for p, q in pairs)
        command = ["wcsware", "-x", str(path)]
        said = subprocess.run(command, input=lines, capture_output=True, text=True, check=True)
        found = re.findall(r"World: *([-\d.]+), *([-\d.]+)", said.stdout)
    else:
        command = ["xy2sky", "-d", "-n", "9", str(path), *(p for pair in pairs for p in pair)]
        said = subprocess.run(command, capture_output=True, text=True, check=True)
        found = re.findall(r"^ *([-\d.]+) +([-\d.]+) +J2000", said.stdout, re.MULTILINE)
    ra, dec = np.array(found, dtype=float).T
    # wcsware prints six decimals, 1e-4 pixel
    limit = export.forward.largest + 2e-4
    assert distances(calibration, ra, dec, index).max() < limit < 0.01


@pytest.mark.parametrize("pole", [False, True])
def test_gwcs_points_where_the_calibration_does(tmp_path: Path, pole: bool) -> None:
    """Near a pole too, where a frame is no rectangle in RA and Dec."""
    pytest.importorskip("gwcs", reason="gwcs is not installed")
    pytest.importorskip("asdf_astropy", reason="asdf-astropy is not installed")
    asdf = pytest.importorskip("asdf")
    plane = PLANES["mirrored"]
    calibration = made(replace(plane, dec=89.95) if pole else plane)
    export = generalized_wcs(calibration, 4)
    export.write(tmp_path / "frame.asdf")
    index = some_pixels(calibration)
    with asdf.open(tmp_path / "frame.asdf") as file:
        wcs, stated = file["wcs"], file["truncation_error"]["forward"]["largest"]
        draws = Table(file["draws"])
        limit = 1.05 * stated + 1e-9
        assert distances(calibration, *wcs(*index), index).max() < limit < 0.05
        wrong = distances(calibration, *wcs(*(index + 1.0)), index)
        assert np.nanmin(wrong) > 0.9  # pixels counted from 1
        at = wcs.pixel_to_world(*index)
        assert distances(calibration, at.ra.deg, at.dec.deg, index).max() < limit
        true, _ = calibration.to_sky(*calibration.from_index(*index))
        back = np.array(wcs.world_to_pixel(true))
        assert np.hypot(*(back - index)).max() < 1.05 * export.inverse.largest + 1e-9
    header = sip(calibration, 4)
    assert export.forward.largest == pytest.approx(header.forward.largest, rel=1e-6)
    assert draws.colnames == header.draws.colnames
    assert np.array_equal(draws["A_2_0"], header.draws["A_2_0"])
    with pytest.raises(InputError, match="exists"):
        export.write(tmp_path / "frame.asdf")


def test_gwcs_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gwcs", None)
    with pytest.raises(InputError, match="not installed"):
        generalized_wcs(made())


LENS = bf.PolynomialDistortion.radial_tangential(focal_length=800.0)
COEFFICIENTS = np.array([-0.12, 0.03, -0.01, 2e-3, -1e-3])  # k1, k2, k3, p1, p2


def test_an_opencv_lens_is_found_exactly() -> None:
    calibration = made(None, distortion=LENS, theta=COEFFICIENTS, spread=0.0)
    camera = opencv_camera(calibration, focal_length=400.0)  # binned 2 x 2
    assert camera["truncation_error_px"]["max"] < 1e-7
    k1, k2, k3, p1, p2 = COEFFICIENTS
    found = dict(zip(NAMES, camera["draws"][0], strict=True))
    expected = [k1, k2, k3, p1, p2, 0.0]
    assert [found[name] for name in ("k1", "k2", "k3", "p1", "p2", "angle")] == pytest.approx(
        expected, abs=1e-6
    )
    middle = 0.5 * (np.array([310.0, 200.0]) - 1.0) + 0.5 * OFFSET
    assert camera["camera_matrix"][:2, 2] == pytest.approx(middle, abs=1e-6)
    assert camera["camera_matrix"][0, 0] == pytest.approx(400.0, abs=1e-6)


@pytest.mark.parametrize("plane", [None, *SIMILAR])
def test_opencv_sees_what_the_calibration_says(plane: str | None) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    calibration = made(SIMILAR[plane] if plane else None)
    camera = opencv_camera(calibration, focal_length=None if plane else 900.0)
    lens = camera["camera_matrix"], camera["distortion_coefficients"]
    index = some_pixels(calibration)
    image = calibration.from_index(*index)
    if plane:
        at, _ = calibration.to_sky(*image)
        points = (camera["axes"] @ at.cartesian.xyz.value).T
        assert np.linalg.det(camera["axes"]) == pytest.approx(-1.0 if plane == "sky" else 1.0)
    else:
        x, y, _ = calibration.to_object(*image)
        points = np.stack([x, y, np.full(x.shape, 900.0 * 2.0)], axis=1)
    turn = cv2.Rodrigues(camera["rotation"])[0]
    found = cv2.projectPoints(points, turn, np.zeros(3), *lens)[0][:, 0].T
    error, stated = np.hypot(*(found - index)), camera["truncation_error_px"]
    assert 0.01 < stated["max"] < 0.5
    assert error.max() < 1.02 * stated["max"]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(stated["rms"], rel=0.15)
    assert np.hypot(*(found - index - 1.0)).min() > stated["max"]  # pixels counted from 1
    rays = cv2.undistortPoints(
        np.ascontiguousarray(index.T)[:, None], *lens, R=camera["rotation"].T
    )[:, 0]
    off = rays.T - points[:, :2].T / points[:, 2]
    assert camera["focal_length"] * np.hypot(*off).max() < 1.1 * stated["max"]


def test_opencv_reads_the_file(tmp_path: Path) -> None:
    camera = opencv_camera(made())
    path = tmp_path / "camera.json"
    write_opencv(path, camera)
    with pytest.raises(InputError, match="exists"):
        write_opencv(path, camera)
    with pytest.raises(InputError, match=r"expected \.json"):
        write_opencv(tmp_path / "camera.txt", camera)
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    for name in ("camera_matrix", "distortion_coefficients", "rotation", "axes", "draws"):
        found = storage.getNode(name).mat()
        assert np.array_equal(found.reshape(camera[name].shape), camera[name])
    stated = storage.getNode("truncation_error_px").getNode("max").real()
    assert stated == camera["truncation_error_px"]["max"]


def test_draws_of_a_camera_are_refits() -> None:
    calibration = made(SIMILAR["sky"], n=40, spread=1e-3)
    draws = opencv_camera(calibration)["draws"]
    spread = draws.std(axis=0)
    for k in (0, 7, 23):
        alone = bf.Calibration(
            FIELD, calibration.draws[[k, k]], calibration.detector, calibration.psf, 2.0,
            calibration.sources, calibration.sky,
        )  # fmt: skip
        full = opencv_camera(alone)["draws"][0]
        assert np.abs((draws[k] - full) / spread).max() < 0.01
        assert np.abs((draws[k + 1] - full) / spread).max() > 0.3  # another draw is another camera


def test_focal_lengths_are_asked_for() -> None:
    for length in (None, 0.0, -3.0, np.nan, np.inf):
        with pytest.raises(InputError, match="focal_length"):
            opencv_camera(made(None), focal_length=length)
    with pytest.raises(InputError, match="it follows from the pixel scale"):
        opencv_camera(made(), focal_length=900.0)


def parsed(text: str) -> tuple[Floats, dict[str, Floats], list[str]]:
    """Circles, arrows by their place, and colours of circles, of a region file."""
    circles = re.findall(r"^circle\(([-\d.]+),([-\d.]+),5\) # color=(\w+)", text, re.MULTILINE)
    arrows = re.findall(r"^# vector\((\S+?,\S+?),([-\d.]+),([-\d.]+)\)", text, re.MULTILINE)
    return (
        np.array([row[:2] for row in circles], dtype=float),
        {at: np.array([length, angle], dtype=float) for at, length, angle in arrows},
        [row[2] for row in circles],
    )


def test_regions_stand_on_the_images(tmp_path: Path) -> None:
    """One source of the frame is not where the catalogue has it."""
    detector = bf.Detector((40, 70), binning=2)
    x, y = (p.ravel() for p in np.meshgrid([-50.0, -20.0, 8.0, 46.0], [-27.0, 6.0, 25.0]))
    field = bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
    moved = x + np.where(np.arange(12) == 5, 0.6, 0.0)
    planted = bf.ForwardModel(
        detector, bf.SourceCatalog(moved, y, np.full(12, 1e6)), bf.GaussianPSF(2.5), field
    )
    model = bf.ForwardModel(
        detector, bf.SourceCatalog(x, y, np.full(12, 1e6)), bf.GaussianPSF(2.5), field
    )
    counts = bf.simulate(planted, [0.02, 0.03], 10.0, seed=2)
    chain = bf.laplace(bf.Posterior(model, counts), seed=1)
    sources = bf.diagnose(chain).sources
    write_regions(tmp_path / "images.reg", sources, detector.shape)
    circles, arrows, colours = parsed((tmp_path / "images.reg").read_text())
    brightest = np.array(
        [
            np.unravel_index(np.argmax(np.where(near, counts, 0.0)), counts.shape)
            for near in (
                np.hypot(*(np.indices(counts.shape) - (at[::-1, None, None] - 1.0))) < 6.0
                for at in circles
            )
        ]
    )
    assert len(circles) == 12
    off = circles[:, ::-1] - 1.0 - brightest
    assert np.abs(off).max() < 0.8 and np.abs(off.mean(axis=0)).max() < 0.3
    assert np.abs((off + 1.0).mean(axis=0)).min() > 0.7  # pixels counted from 0
    longest = max(arrows, key=lambda at: arrows[at][0])
    place = np.array(longest.split(","), dtype=float)
    assert np.argmin(np.hypot(*(circles - place).T)) == 5
    # 0.6 fine pixels to the right, enlarged 100 times; the fit absorbs some of it
    length, angle = arrows[longest]
    assert 20.0 < length < 32.0
    assert min(angle, 360.0 - angle) < 10.0
    assert colours[5] == "red"
    with pytest.raises(InputError, match="exists"):
        write_regions(tmp_path / "images.reg", sources, detector.shape)


def test_regions_leave_out_what_is_not_known() -> None:
    columns = {
        "id": [0, 1, 2, 3], "u": [0.5, np.nan, -3.0, 40.0], "v": [1.0, 2.0, 0.0, 0.0],
        "n_pixels": [9, 9, 9, 0], "du": [np.nan, 0.1, -0.3, np.nan], "dv": [0.1, 0.1, -0.4, 0.1],
        "failed": [False, False, True, False],
    }  # fmt: skip
    circles, arrows, colours = parsed(residual_regions(Table(columns), (11, 20), enlargement=10.0))
    assert circles.tolist() == [[11.0, 7.0], [7.5, 6.0]]
    assert colours == ["green", "red"]
    (arrow,) = arrows.values()
    assert arrow == pytest.approx([5.0, 180.0 + 53.1301])
    with pytest.raises(InputError, match="no column failed"):
        residual_regions(Table({name: columns[name] for name in list(columns)[:-1]}), (11, 20))
    for enlargement in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="enlargement"):
            residual_regions(Table(columns), (11, 20), enlargement=enlargement)


def test_a_plate_is_the_same_for_equal_draws() -> None:
    plate = fit_plate(made(spread=0.0), 3)
    for values in (plate.reference, plate.cd, plate.forward, plate.inverse):
        assert np.ptp(values, axis=0).max() < 1e-12 * np.abs(values).max()

"""The sky: the tangent plane against astropy, headers, angles of tables, proper motions."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

import bayesfred as bf
from bayesfred.io.catalogues import read_sky_catalogue
from bayesfred.io.frames import read_frame
from bayesfred.io.sky import degrees, header_date, moved, plane_of_wcs
from bayesfred.io.tangent_plane import TangentPlane

PLANES = {
    "tilted": TangentPlane(200.3, -71.2, ((-0.011, 0.002), (0.0015, 0.0112)), (3.0, -5.0)),
    "across RA 0": TangentPlane(0.02, 5.0, ((0.004, 0.003), (0.003, -0.004)), (100.0, 70.0)),
    "at the pole": TangentPlane(77.0, 89.99, ((0.001, 0.01), (0.01, -0.001))),
}


def header(plane: TangentPlane) -> fits.Header:
    """The cards of a plane for a frame of 100 rows and 60 columns."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.cd = (
        ("RA---TAN", "DEC--TAN"),
        (plane.ra, plane.dec),
        plane.matrix,
    )
    wcs.wcs.crpix = np.add(plane.origin, (30.5, 50.5))
    return wcs.to_header()


@pytest.mark.parametrize("plane", PLANES.values(), ids=PLANES)
def test_projection_is_astropys(plane: TangentPlane) -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-500.0, 500.0, (2, 100))
    sky = WCS(header(plane)).pixel_to_world(x + 29.5, y + 49.5)
    ra, dec = plane.to_sky(x, y)
    assert sky.separation(SkyCoord(ra, dec, unit="deg")).arcsec.max() < 1e-6
    back = np.array(plane.to_plane(ra, dec))
    np.testing.assert_allclose(back, [x, y], atol=1e-8)


@pytest.mark.parametrize("plane", PLANES.values(), ids=PLANES)
def test_jacobian_is_the_derivative(plane: TangentPlane) -> None:
    x, y = np.random.default_rng(2).uniform(-500.0, 500.0, (2, 50))
    jacobian, step = plane.jacobian(x, y), 0.01
    middle = SkyCoord(*plane.to_sky(x, y), unit="deg")
    for axis, (dx, dy) in enumerate(((step, 0.0), (0.0, step))):
        ends = [
            middle.spherical_offsets_to(SkyCoord(*plane.to_sky(x + s * dx, y + s * dy), unit="deg"))
            for s in (1.0, -1.0)
        ]
        for row in (0, 1):
            slope = (ends[0][row] - ends[1][row]).arcsec / (2.0 * step)
            np.testing.assert_allclose(jacobian[:, row, axis], slope, atol=1e-3)


def test_directions_behind_are_nowhere() -> None:
    plane = PLANES["tilted"]
    x, y = plane.to_plane([plane.ra + 180.0, plane.ra], [-plane.dec, plane.dec])
    assert np.isnan(x[0])
    assert np.isnan(y[0])
    np.testing.assert_allclose([x[1], y[1]], plane.origin, atol=1e-9)


@pytest.mark.parametrize(
    ("angle", "parity"), [(0.0, "sky"), (30.0, "sky"), (-120.0, "mirrored"), (179.0, "mirrored")]
)
def test_angle_and_parity(angle: float, parity: str) -> None:
    sin, cos = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    right = -1.0 if parity == "sky" else 1.0
    plane = TangentPlane(10.0, 20.0, ((right * cos, sin), (-right * sin, cos)))
    assert plane.parity == parity
    assert plane.position_angle == pytest.approx(angle)
    middle = SkyCoord(10.0, 20.0, unit="deg")
    up = SkyCoord(*plane.to_sky(0.0, 0.001), unit="deg")
    assert middle.position_angle(up).wrap_at("180d").deg == pytest.approx(angle, abs=1e-3)


@pytest.mark.parametrize(
    "wrong",
    [
        {"matrix": ((1.0, 2.0), (2.0, 4.0))},
        {"dec": 91.0},
        {"ra": np.nan},
        {"origin": (np.inf, 0.0)},
    ],
)
def test_no_plane(wrong: dict[str, object]) -> None:
    given = {"ra": 1.0, "dec": 2.0, "matrix": ((1.0, 0.0), (0.0, 1.0)), **wrong}
    with pytest.raises(bf.InputError, match="got"):
        TangentPlane(**given)  # type: ignore[arg-type]


def test_a_header_with_distortion_gives_its_slope_in_the_middle() -> None:
    cards = header(PLANES["tilted"])
    cards["CTYPE1"], cards["CTYPE2"] = "RA---TAN-SIP", "DEC--TAN-SIP"
    cards["A_ORDER"], cards["B_ORDER"], cards["A_2_0"], cards["B_1_1"] = 2, 2, 1e-3, -2e-3
    wcs = WCS(cards)
    plane = plane_of_wcs(wcs, (100, 60))
    at = wcs.pixel_to_world(29.5 + 0.1, 49.5)
    x, y = plane.to_plane(at.ra.deg, at.dec.deg)
    assert (float(x), float(y)) == pytest.approx((0.1, 0.0), abs=1e-4)


def test_binning_makes_pixels_finer() -> None:
    wcs = WCS(header(PLANES["tilted"]))
    coarse, fine = (plane_of_wcs(wcs, (100, 60), binning=b) for b in (1, 3))
    assert fine.pixel_scale == pytest.approx(coarse.pixel_scale / 3.0)


def test_a_frames_header_is_read(tmp_path: Path) -> None:
    cards = header(PLANES["across RA 0"])
    cards["DATE-OBS"] = "2019-07-29T20:47:26"
    fits.PrimaryHDU(np.ones((100, 60), np.int16), cards).writeto(tmp_path / "frame.fits")
    frame = read_frame(tmp_path / "frame.fits")
    assert frame.date == "2019-07-29T20:47:26"
    assert frame.sky is not None
    ra, dec = PLANES["across RA 0"].to_sky(0.0, 0.0)
    assert (frame.sky.ra, frame.sky.dec) == pytest.approx((float(ra), float(dec)))
    fits.PrimaryHDU(np.ones((100, 60), np.int16)).writeto(tmp_path / "plain.fits")
    assert read_frame(tmp_path / "plain.fits").sky is None


@pytest.mark.parametrize(
    ("values", "unit", "hours", "expected"),
    [
        ([180.5], None, True, 180.5),
        ([12.0], "hourangle", True, 180.0),
        ([np.pi], "rad", False, 180.0),
        (["12:30:00"], None, True, 187.5),
        (["12h30m00s"], None, True, 187.5),
        (["187d30m"], None, True, 187.5),
        (["-12:30:00"], None, False, -12.5),
        (["-00:30:00"], None, False, -0.5),
    ],
)
def test_angles(values: list[object], unit: str | None, hours: bool, expected: float) -> None:
    from astropy import units

    found = degrees(values, units.Unit(unit) if unit else None, hours=hours)
    assert found[0] == pytest.approx(expected)


def test_a_catalogue_with_units_is_that_without(tmp_path: Path) -> None:
    plain = "ra,dec,flux\n279.234583,38.783639,5\n10.5,-20.25,7\n"
    (tmp_path / "plain.csv").write_text(plain)
    table = Table.read(plain.splitlines(), format="ascii.csv")
    table["ra"] = table["ra"] / 15.0
    table["ra"].unit = "hourangle"
    table.write(tmp_path / "hours.ecsv")
    (tmp_path / "text.csv").write_text(
        "ra,dec,flux\n18:36:56.3,38:47:01.1,5\n00h42m00s,-20d15m00s,7\n"
    )
    records = [
        read_sky_catalogue(tmp_path / name) for name in ("plain.csv", "hours.ecsv", "text.csv")
    ]
    for record in records[1:]:
        np.testing.assert_allclose(record.ra, records[0].ra, atol=1e-5)
        np.testing.assert_allclose(record.dec, records[0].dec, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ra,dec\n1,91\n", "row 1, column 'dec': got 91, expected a declination"),
        ("ra,dec\n1,2\nx,3\n", "row 2, column 'ra': got 'x', expected degrees"),
        ("ra,de\n1,2\n", "got no column 'dec', expected one of: 'ra', 'de'"),
        ("ra,dec\n1,2\n1,2\n", "row 2: got position (1, 2) again, as in row 1"),
        ("ra,dec\n1,\n", "row 1, column 'dec': got nothing"),
    ],
)
def test_a_bad_catalogue_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "stars.csv"
    path.write_text(text)
    with pytest.raises(bf.InputError) as caught:
        read_sky_catalogue(path, flux=None)
    assert message in str(caught.value)


def test_proper_motion(tmp_path: Path) -> None:
    """Barnard's star moves 10.39 arcsec a year, mostly north."""
    ra, dec = moved(
        np.array([269.452]), np.array([4.6934]), (np.array([-802.8]), np.array([10362.5])),
        2000.0, "2019-01-01T00:00:00",
    )  # fmt: skip
    before = SkyCoord(269.452, 4.6934, unit="deg")
    moved_by = before.separation(SkyCoord(ra, dec, unit="deg")).arcsec[0]
    assert moved_by == pytest.approx(19.0 * np.hypot(0.8028, 10.3625), rel=1e-4)
    (tmp_path / "stars.csv").write_text("ra,dec,a,b\n1,2,3,4\n")
    with pytest.raises(bf.InputError, match=r"expected the date of the frame too: give sky\.date"):
        read_sky_catalogue(tmp_path / "stars.csv", flux=None, motion=("a", "b"))
    with pytest.raises(bf.InputError, match="date: got 'yesterday'"):
        moved(ra, dec, (ra, dec), 2000.0, "yesterday")


def test_units_of_columns_are_honoured(tmp_path: Path) -> None:
    """A proper motion of an arcsecond a year is not one of a milliarcsecond."""
    from astropy import units

    found = []
    for scale, unit in ((1.0, None), (1e-3, "arcsec / yr"), (1e-3 / 3600.0, "deg / yr")):
        table = Table({"ra": [10.0], "dec": [20.0], "a": [500.0 * scale], "b": [-200.0 * scale]})
        for name in ("a", "b") if unit else ():
            table[name].unit = units.Unit(unit)
        table.write(tmp_path / "stars.ecsv", overwrite=True)
        record = read_sky_catalogue(
            tmp_path / "stars.ecsv", flux=None, motion=("a", "b"), epoch=2000.0, date="2020-01-01"
        )
        found.append([record.ra[0], record.dec[0]])
    np.testing.assert_allclose(found[1:], [found[0]] * 2, rtol=0.0, atol=1e-9)
    assert found[0][1] == pytest.approx(20.0 - 20.0 * 0.2 / 3600.0, abs=1e-6)
    for column, unit in (("ra", "m"), ("a", "m / s")):
        table = Table({"ra": [10.0], "dec": [20.0], "a": [5.0], "b": [2.0]})
        table[column].unit = units.Unit(unit)
        table.write(tmp_path / "stars.ecsv", overwrite=True)
        with pytest.raises(bf.InputError, match=f"column '{column}': got the unit '{unit}'"):
            read_sky_catalogue(
                tmp_path / "stars.ecsv", flux=None, motion=("a", "b"), date="2020-01-01"
            )


def test_degrees_among_texts_are_refused(tmp_path: Path) -> None:
    (tmp_path / "stars.csv").write_text("ra,dec\n05:32:00,1\n83.0,2\n")
    with pytest.raises(bf.InputError, match=r"row 2, column 'ra': got '83\.0'"):
        read_sky_catalogue(tmp_path / "stars.csv", flux=None)


@pytest.mark.parametrize(
    ("cards", "date"),
    [
        ({"MJD-OBS": 58849.0, "DATE-OBS": "2019-07-29"}, "2019-07-29"),
        ({"MJD-OBS": 58849.0}, "2020-01-01T00:00:00.000"),
        ({"DATE-BEG": "2020-01-01T00:00:00"}, "2020-01-01T00:00:00"),
        ({}, None),
    ],
)
def test_dates_of_headers(cards: dict[str, object], date: str | None) -> None:
    assert header_date(cards) == date


def test_from_sky_says_what_is_missing() -> None:
    wcs = WCS(header(PLANES["tilted"]))
    stars = SkyCoord([200.0, 20.0], [-71.0, 71.0], unit="deg")
    with pytest.raises(bf.InputError, match=r"set wcs\.pixel_shape"):
        bf.SourceCatalog.from_sky(stars, [1.0, 1.0], wcs)
    wcs.pixel_shape = (60, 100)
    with pytest.raises(bf.InputError, match="got star 1 more than 90 degrees"):
        bf.SourceCatalog.from_sky(stars, [1.0, 1.0], wcs)
    linear = WCS(naxis=2)
    linear.pixel_shape = (60, 100)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(bf.InputError, match="expected celestial axes"):
            bf.SourceCatalog.from_sky(stars, [1.0, 1.0], linear)
    placed = bf.SourceCatalog.from_sky(stars[:1], [1.0], wcs)
    column, row = wcs.world_to_pixel(stars[0])
    assert (placed.x[0], placed.y[0]) == pytest.approx((column - 29.5, row - 49.5))

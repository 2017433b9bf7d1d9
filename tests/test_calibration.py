"""A calibration: positions in both directions, their covariance, files, maps and differences."""

import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from scipy import stats

import bayesfred as bf
from bayesfred._typing import Floats
from bayesfred.calibration.maps import write_maps
from bayesfred.io.tangent_plane import TangentPlane
from bayesfred.model.parameters import displacing
from bayesfred.sampling.displacement import spread_draws

SKY = TangentPlane(83.0, -41.0, ((-0.004, 0.006), (0.006, 0.004)), (4.0, -3.0))
SHAPE = (101, 141)
TERMS = [(1, 0, 0, 0), (0, 1, 0, 0), (2, 0, 0, 0), (1, 2, 0, 0), (3, 0, 0, 0), (1, 0, 2, 0)]
LENS = bf.PolynomialDistortion(TERMS, [(0, 1, 0, 0), (2, 1, 0, 0), (0, 3, 0, 0), (1, 0, 0, 1)])
THETA = np.array([0.01, -0.02, 2e-4, 3e-6, 4e-6, 1e-6, 0.015, -2e-6, 5e-6, 1e-4])
OFFSET = np.array([0.7, -0.4])
SPREAD = np.abs(THETA) * 0.02


def calibration(*, seed: int = 1, binning: int = 1, shift: Floats | None = None) -> bf.Calibration:
    """A calibration with given draws; `shift` moves all of them."""
    truth = np.concatenate([THETA, OFFSET]) + (0.0 if shift is None else shift)
    sd = np.concatenate([SPREAD, [0.01, 0.02]])
    draws = truth + sd * np.random.default_rng(seed).normal(size=(1000, truth.size))
    edge = 45.0 * binning
    sources = np.array([[-edge, -edge], [edge, -edge], [edge, edge], [-edge, edge]])
    detector = bf.Detector(SHAPE, binning=binning)
    psf = bf.GaussianPSF(2.0)
    return bf.Calibration(LENS, draws, detector, psf, 2.5, sources, SKY, "night 3", "trustworthy")


def points(number: int, seed: int = 2) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-45.0, 45.0, number), rng.uniform(-45.0, 45.0, number)


@pytest.mark.parametrize("number", [7, 20_000])
def test_round_trips(number: int) -> None:
    """Few points are followed from the axis, many begin from a spline."""
    one, (u, v) = calibration(), points(number)
    x, y, _ = one.to_object(u, v)
    assert np.hypot(x - u, y - v).max() > 1.0
    back = one.to_image(x, y)
    np.testing.assert_allclose(back[:2], [u, v], rtol=0.0, atol=1e-9)
    at, _ = one.to_sky(u, v)
    np.testing.assert_allclose(one.to_pixel(at)[:2], [u, v], rtol=0.0, atol=1e-9)
    mean = one.positions.mean
    f, g = LENS.displacement(mean[:-2], u, v, x, y)
    np.testing.assert_allclose([u - x + f, v - y + g], mean[-2:, None] + 0.0 * np.array([u, v]))


def test_delta_method_and_draws_agree() -> None:
    """The draws are the same, so what differs is the second order: below 2 % here."""
    one, (u, v) = calibration(), points(40)
    x, y, _ = one.to_object(u, v)
    at, _ = one.to_sky(u, v)
    for to, given in ((one.to_object, (u, v)), (one.to_image, (x, y)), (one.to_sky, (u, v)),
                      (one.to_pixel, (at,))):  # fmt: skip
        delta, draws = (to(*given, method=m)[-1] for m in ("delta", "draws"))  # type: ignore[operator]
        scale = np.trace(draws, axis1=-2, axis2=-1)[:, None, None]
        assert np.abs((delta - draws) / scale).max() < 0.02
        assert np.linalg.eigvalsh(delta).min() > 0.0


def test_covariance_is_that_of_finite_differences() -> None:
    """J C J^T with J by differences of the positions themselves."""
    one, (u, v) = calibration(), points(5)
    mean, covariance = one.positions.mean, one.positions.covariance
    x, y, _ = one.to_object(u, v)
    for images, at in ((False, (u, v)), (True, (x, y))):
        to = LENS.image_position if images else LENS.object_position
        columns = []
        for k, sd in enumerate(np.sqrt(np.diag(covariance))):
            step = 0.1 * sd * np.eye(mean.size)[k]
            ends = [
                np.array(to((mean + s * step)[:-2], *at, offset=(mean + s * step)[-2:]))
                for s in (1.0, -1.0)
            ]
            columns.append((ends[0] - ends[1]) / (0.2 * sd))
        jacobian = np.moveaxis(np.array(columns), 0, -1).swapaxes(0, 1)
        expected = jacobian @ covariance @ jacobian.swapaxes(1, 2)
        found = (one.to_image if images else one.to_object)(*at)[2]
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-12)


def test_high_powers_keep_their_digits() -> None:
    """A polynomial of degree 5 on a large frame: coefficients from 1e-3 to 1e-16."""
    lens = bf.PolynomialDistortion.polynomial(5)
    reach = lens.largest_displacement(1000.0, 1000.0).max(axis=0)
    rng = np.random.default_rng(8)
    draws = np.hstack([rng.normal(size=(500, lens.n_terms)) / reach * 1e-3, np.zeros((500, 2))])
    one = replace(calibration(), distortion=lens, draws=draws, detector=bf.Detector((2001, 2001)))
    u, v = 20.0 * points(30)[0], 20.0 * points(30)[1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", bf.ExtrapolationWarning)
        delta, each = (one.to_object(u, v, method=m)[2] for m in ("delta", "draws"))  # type: ignore[arg-type]
    np.testing.assert_allclose(delta, each, rtol=0.01, atol=0.01 * np.abs(each).max())
    # the covariance itself has lost them: this is what is not done
    values, vectors = np.linalg.eigh(one.positions.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    design = lens.design_matrix(u, v, u, v)[0] @ root[:-2] - root[-2]
    assert np.abs(np.sum(design**2, axis=1) / each[:, 0, 0] - 1.0).max() > 0.1


def test_sky_covariance_is_along_east_and_north() -> None:
    one, (u, v) = calibration(), points(10)
    _, covariance = one.to_sky(u, v)
    x, y = LENS.object_position(one.draws[:, :-2], u, v, offset=one.draws[:, -2:])
    mean = SkyCoord(*SKY.to_sky(x.mean(axis=0), y.mean(axis=0)), unit="deg")
    each = SkyCoord(*SKY.to_sky(x, y), unit="deg")
    east, north = (part.arcsec for part in mean[None].spherical_offsets_to(each))
    for k in range(len(u)):
        expected = np.cov(east[:, k], north[:, k])
        np.testing.assert_allclose(covariance[k], expected, rtol=0.02, atol=0.02 * expected.max())


def test_index_counts_from_zero_at_the_first_pixel() -> None:
    one = calibration(binning=3)
    assert [float(p) for p in one.index(0.0, 0.0)] == [70.0, 50.0]
    assert [float(p) for p in one.from_index(0, 100)] == [-210.0, 150.0]
    np.testing.assert_allclose(one.index(*one.from_index(12.25, 7.5)), [12.25, 7.5])


def test_extrapolation_is_said() -> None:
    one = calibration()
    with pytest.warns(
        bf.ExtrapolationWarning, match="2 of 3 points are beyond the sources"
    ) as seen:
        one.to_object([0.0, 60.0, 0.0], [0.0, 0.0, -50.0])
    assert seen[0].filename == __file__
    with pytest.warns(bf.ExtrapolationWarning):
        one.to_sky(60.0, 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one.to_object(*points(100))
    assert one.inside([0.0, 60.0], 0.0).tolist() == [True, False]


def test_a_fold_has_no_object() -> None:
    folded = bf.PolynomialDistortion([(2, 0, 0, 0)], [])
    draws = np.array([[-0.01, 0.0, 0.0], [-0.0101, 0.0, 0.0]])
    one = replace(calibration(), distortion=folded, draws=draws)
    x, _, covariance = one.to_object([10.0, -40.0], [0.0, 0.0])
    assert np.isfinite(x).tolist() == [True, False]
    assert np.isfinite(covariance).all(axis=(1, 2)).tolist() == [True, False]


def test_file_is_whole_and_needs_no_frame(tmp_path: Path) -> None:
    one, path = calibration(), tmp_path / "lens.h5"
    one.write(path)
    again = bf.Calibration.read(path)
    u, v = points(20)
    for a, b in zip(one.to_object(u, v), again.to_object(u, v), strict=True):
        assert np.array_equal(a, b)
    assert (again.sky, again.title, again.message) == (SKY, "night 3", "trustworthy")
    with pytest.raises(bf.InputError, match=r"lens\.h5: exists, expected a new file"):
        one.write(path)
    one.write(path, overwrite=True)
    content = bytearray(path.read_bytes())
    content[2000] ^= 1
    path.write_bytes(content)
    with pytest.raises(bf.InputError, match="got another content than its seal says"):
        bf.Calibration.read(path)


def test_a_chain_is_no_calibration_and_the_reverse(tmp_path: Path) -> None:
    path = tmp_path / "lens.h5"
    calibration().write(path)
    with pytest.raises(bf.InputError, match="expected bayesfred chain of schema"):
        bf.open_chain(path)
    with pytest.raises(bf.InputError, match="expected a calibration written by `bayesfred calibr"):
        bf.Calibration.read(tmp_path / "absent.h5")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"draws": np.zeros((1, 12))}, r"got shape \(1, 12\), expected \(n, 12\) with n > 1"),
        ({"draws": np.zeros((5, 3))}, r"got shape \(5, 3\)"),
        ({"draws": np.full((5, 12), np.nan)}, "not finite"),
        ({"sources": np.zeros(3)}, r"sources: got shape \(3,\)"),
    ],
)
def test_what_is_no_calibration(wrong: dict[str, Floats], message: str) -> None:
    with pytest.raises(bf.InputError, match=message):
        replace(calibration(), **wrong)


def test_without_a_sky_it_says_so() -> None:
    one = replace(calibration(), sky=None)
    with pytest.raises(bf.InputError, match="of a catalogue with ra and dec"):
        one.to_sky(0.0, 0.0)
    with pytest.raises(bf.InputError, match="points: got"):
        one.to_object([1.0, 2.0], [1.0, 2.0, 3.0])


def test_maps_are_the_positions(tmp_path: Path) -> None:
    one = calibration()
    found = one.displacement_map(10.0)
    assert found.u.tolist() == [10.0 * k for k in range(-7, 8)]
    assert found.v.tolist() == [10.0 * k for k in range(-5, 6)]
    x, y, covariance = one.to_object([20.0], [-30.0])
    np.testing.assert_allclose(found.displacement[2, 9], [20.0 - x[0], -30.0 - y[0]])
    np.testing.assert_allclose(found.covariance[2, 9], covariance[0])
    np.testing.assert_allclose(found.sd[2, 9] ** 2, np.diag(covariance[0]))
    assert found.inside.sum() == 9 * 9
    write_maps(one, tmp_path / "maps.fits", 10.0)
    with fits.open(tmp_path / "maps.fits", checksum=True) as hdus:
        assert [h.name for h in hdus[1:]] == ["DISP_U", "DISP_V", "SD_U", "SD_V", "FWHM", "E1",
                                              "E2", "INSIDE"]  # fmt: skip
        np.testing.assert_array_equal(hdus["DISP_V"].data, found.displacement[..., 1])
        assert WCS(hdus["SD_U"].header).pixel_to_world_values(9, 2)[0] == pytest.approx(20.0)
    with pytest.raises(bf.InputError, match="exists"):
        write_maps(one, tmp_path / "maps.fits", 10.0)
    with pytest.raises(bf.InputError, match="step: got 0"):
        one.displacement_map(0)


@pytest.mark.parametrize("psf", [bf.GaussianPSF(2.0), bf.MoffatPSF(4.7, 3.0)], ids=["g", "m"])
def test_psf_map_sees_the_distortion(psf: bf.GaussianPSF | bf.MoffatPSF) -> None:
    """With a = s u, b = t v the image of a round PSF has the axes 1/s and 1/t.

    The moments of a Gaussian are exact, but for the samples' end at 4 widths. Those of wide wings,
    whose weight is round on the image, are those of an ellipse to some per cent.
    """
    linear = bf.PolynomialDistortion([(1, 0, 0, 0), (1, 0, 1, 0)], [(0, 1, 0, 0)])
    exact = isinstance(psf, bf.GaussianPSF)
    draws = np.array([[0.0, 2e-3, 0.0, 0.0, 0.0]] * 2)
    one = replace(calibration(), distortion=linear, draws=draws, psf=psf, psf_sigma=1.2 * psf.sigma)
    found = one.psf_map(20.0)
    x, _, _ = one.to_object(40.0, 0.0)
    slope = 1.0 + 2e-3 * float(x)
    k = found.u.tolist().index(40.0)
    expected = (1.0 - slope**2) / (1.0 + slope**2)
    assert found.ellipticity[2, k, 0] == pytest.approx(expected, rel=1e-5 if exact else 0.1)
    assert found.ellipticity[2, k, 1] == pytest.approx(0.0, abs=1e-9)
    fwhm = 1.2 * psf.sigma * np.sqrt(8.0 * np.log(2.0)) / np.sqrt(slope)
    assert found.fwhm[2, k] == pytest.approx(fwhm, rel=1e-5 if exact else 0.02)


def pairs(number: int, *, doubt: float = 1.0) -> Iterator[tuple[bf.Calibration, bf.Calibration]]:
    """Calibrations of one camera whose means scatter by their errors times `doubt`."""
    rng, sd = np.random.default_rng(11), np.concatenate([SPREAD, [0.01, 0.02]])
    for k in range(number):
        a, b = (
            calibration(seed=2 * k + j, shift=doubt * sd * rng.normal(size=sd.size)) for j in (0, 1)
        )
        yield a, b


def p_values(number: int, *, doubt: float = 1.0) -> Floats:
    return np.array([a.difference(b).agreement.p for a, b in pairs(number, doubt=doubt)])


@pytest.mark.slow
def test_difference_has_uniform_p_values() -> None:
    """60 pairs without a change: a Kolmogorov test at 0.001.

    Errors 1.5 times too small fail it.
    """
    assert stats.kstest(p_values(60), "uniform").pvalue > 1e-3
    assert stats.kstest(p_values(60, doubt=1.5), "uniform").pvalue < 1e-3


def test_difference_sees_the_lens() -> None:
    lens = np.zeros(12)
    lens[4] = 6.0 * SPREAD[4]
    found = [a.difference(replace(b, draws=b.draws + lens)) for a, b in pairs(30)]
    assert np.mean([each.changed for each in found]) > 0.5
    changed = next(each for each in found if each.changed)
    assert changed.message.startswith("the camera has changed: beyond shift, rotation and scale")


def test_difference_on_the_sky_is_free_of_the_pose() -> None:
    """The same camera turned and pointed elsewhere, with another scale of its object plane."""
    turn, scale = np.radians(70.0), 1.001
    rotation = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    (p, q), (r, s) = (rotation @ np.array(SKY.matrix)).tolist()
    sky = TangentPlane(200.0, 10.0, ((p, q), (r, s)), (9.0, 5.0))
    found = [a.difference(replace(b, sky=sky)) for a, b in pairs(40)]
    assert stats.kstest([each.agreement.p for each in found], "uniform").pvalue > 1e-3
    off = np.array([(each.scale - 0.001) / each.scale_sd for each in found])
    assert abs(off.mean()) < 4.0 / np.sqrt(40)
    assert abs(np.mean(off**2) - 1.0) < 4.0 * np.sqrt(2.0 / 40)


def test_what_cannot_be_compared() -> None:
    a, b = calibration(), calibration(seed=3)
    with pytest.raises(bf.InputError, match="expected both or neither"):
        a.difference(replace(b, sky=None))
    with pytest.raises(bf.InputError, match="expected those of one camera"):
        a.difference(calibration(binning=2))
    with pytest.raises(bf.InputError, match="sources of both"):
        a.difference(replace(b, sources=b.sources * 0.01))


# A frame whose calibration is refitted: 7 x 7 stars of a camera of sigma 2.
CAMERA = bf.PolynomialDistortion([(1, 0, 0, 0), (3, 0, 0, 0), (1, 2, 0, 0)], [(0, 1, 0, 0)])
TRUE = np.array([0.01, 2e-6, 3e-6, -0.01])
PLACES_U = np.array([0.0, 30.0, -60.0, 78.0])  # the last two outside the stars, one in the corner
PLACES_V = np.array([0.0, -40.0, 0.0, 78.0])


def refits(number: int) -> tuple[Floats, Floats]:
    """How far `to_sky` is off along east and north, and the covariance that it states."""
    stars = replace(bf.SourceCatalog.grid(7, 16.0, 3e3), sky=SKY)
    model = bf.ForwardModel(bf.Detector((161, 161)), stars, bf.GaussianPSF(2.0), CAMERA)
    moving = bf.Nuisances(offset=True)
    planned = bf.Posterior(model, np.ones((161, 161)), nuisances=moving)
    params = np.concatenate([TRUE, [5.0], OFFSET])
    x, y = CAMERA.object_position(TRUE, PLACES_U, PLACES_V, offset=OFFSET)
    truth = SkyCoord(*SKY.to_sky(x, y), unit="deg")
    off, stated = [], []
    for seed in range(number):
        counts = planned.simulate(params, np.random.default_rng(seed))
        assert counts is not None
        chain = bf.laplace(bf.Posterior(model, counts, nuisances=moving), seed=seed, progress=False)
        draws = np.hstack(displacing(planned.parameters, spread_draws(chain)))
        if seed == 0:  # what judges the fit too, which takes longer than the fit
            known = bf.Calibration.from_chain(chain)
            assert np.array_equal(known.draws, draws)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", bf.ExtrapolationWarning)
            at, covariance = replace(known, draws=draws).to_sky(PLACES_U, PLACES_V)
        off.append(np.stack([part.arcsec for part in truth.spherical_offsets_to(at)], axis=1))
        stated.append(covariance)
    return np.array(off), np.array(stated)


def judged(off: Floats, stated: Floats) -> None:
    """Coverage of 68 % along both axes, and the covariance, at every place.

    Of n frames a share of 68 % has the error 0.47 / sqrt(n), a variance the relative one
    sqrt(2 / n), and a correlation 1 / sqrt(n).
    """
    n = len(off)
    sd = np.sqrt(np.diagonal(stated, axis1=-2, axis2=-1))
    inside = (np.abs(off) < sd).mean(axis=0)
    assert np.abs(inside - 0.683).max() < 4.0 * 0.47 / np.sqrt(n)
    assert abs(inside.mean() - 0.683) < 0.05
    for place in range(off.shape[1]):
        found, expected = np.cov(off[:, place].T), stated[:, place].mean(axis=0)
        whiten = np.linalg.inv(np.linalg.cholesky(expected))
        left = whiten @ found @ whiten.T - np.eye(2)
        assert np.abs(np.diag(left)).max() < 4.0 * np.sqrt(2.0 / n)
        assert abs(left[0, 1]) < 4.0 / np.sqrt(n)


@pytest.mark.statistics
def test_coverage_on_the_sky() -> None:
    """200 refits at four places, one of them in the frame's corner, beyond the stars."""
    off, stated = refits(200)
    judged(off, stated)
    for wrong in (stated * 1.5, stated / 1.5, stated[..., ::-1, ::-1]):
        with pytest.raises(AssertionError):
            judged(off, wrong)

"""`bayesfred init`: the run file that a frame's own noise proposes."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from test_analysis_photon_transfer import GAIN, NOISE, PEDESTAL, ZERO, scene, stored
from typer.testing import CliRunner

import bayesfred as bf
from bayesfred.cli import app
from bayesfred.settings.run import read_settings


def invoke(*arguments: Any) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, ["init", *map(str, arguments)])
    return done.exit_code, done.stdout, done.stderr


def frames(folder: Path, number: int = 2, **cards: Any) -> list[Path]:
    rng, light = np.random.default_rng(5), scene("stars")
    paths = [folder / f"night{k}.fits" for k in range(number)]
    for path in paths:
        fits.PrimaryHDU(stored(light, rng), fits.Header(cards)).writeto(path)
    return paths


def sd(text: str, key: str) -> float:
    found = re.search(rf"^{key} = .*\+- ([\d.e+-]+)", text, re.MULTILINE)
    assert found is not None
    return float(found[1].rstrip(":"))


def test_a_frame_proposes_its_run_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first, _ = frames(tmp_path, GAIN=2.4)
    code, printed, _ = invoke(first)
    assert code == 0 and "gain 2." in printed and "night0.toml" in printed
    text = (tmp_path / "night0.toml").read_text()
    run = read_settings(tmp_path / "night0.toml")
    assert abs(run.frame.gain - GAIN) < 4.0 * sd(text, "gain")
    assert abs(run.frame.pedestal - ZERO) < 4.0 * sd(text, "pedestal")
    assert "in the header GAIN = 2.4" in text and run.noise.read_noise == 0.0
    assert 0.8 < run.psf.sigma < 1.4  # of stars of 1 pixel
    code, _, error = invoke(first)
    assert code == 2 and "night0.toml: exists" in error
    assert invoke(first, "--overwrite")[0] == 0


def test_two_frames_and_headers_tell_the_read_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    first, second = frames(tmp_path, RDNOISE=NOISE)
    assert invoke(first, "--out", "one.toml")[0] == 0
    one = read_settings(tmp_path / "one.toml")
    assert one.noise.read_noise == NOISE
    assert abs(one.frame.pedestal - PEDESTAL) < 4.0 * sd(Path("one.toml").read_text(), "pedestal")
    assert invoke(first, second, "--out", "two.toml")[0] == 0
    two = read_settings(tmp_path / "two.toml")
    assert abs(two.noise.read_noise - NOISE) < 0.5 * NOISE


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("absent.fits",), "absent.fits: no such file"),
        (("night0.fits", "absent.fits"), "absent.fits: no such file"),
        (("night0.fits", "--out", "run.h5"), "run.h5: got a run file of this name"),
    ],
)
def test_refusals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    frames(tmp_path, 1)
    code, printed, error = invoke(*arguments)
    assert code == 2 and said in error and not printed and error.count("\n") == 1


def test_a_frame_that_says_nothing_of_its_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("dark.npy", np.random.default_rng(1).normal(100.0, 3.0, (99, 99)))
    code, printed, _ = invoke("dark.npy")
    assert code == 0 and "does not measurably grow" in printed
    run = read_settings(tmp_path / "dark.toml")
    assert run.frame.gain is None
    # a name that TOML would misread is quoted
    Path("a\"b\\'.npy").write_bytes(Path("dark.npy").read_bytes())
    assert invoke("a\"b\\'.npy")[0] == 0
    assert read_settings(tmp_path / "a\"b\\'.toml").frame.path == "a\"b\\'.npy"


def camera(folder: Path, fwhm: float, n: int = 10, hot: int = 60) -> dict[str, float]:
    """A stranger's frame and catalogue in a folder; the coefficients of the lens that made it.

    Pinholes of unlike brightness, a background that is no plane, stars that the catalogue lacks,
    hot pixels, gain, read noise and pedestal.
    """
    rng, size = np.random.default_rng(11), 320
    grid = (np.arange(n) - 0.5 * (n - 1)) * size / (n + 1)
    x, y = (each.ravel() for each in np.meshgrid(grid, grid))
    few = rng.uniform(-0.5 * size, 0.5 * size, (2, 20))
    flux = np.append(10.0 ** rng.uniform(3.3, 4.8, x.size), 10.0 ** rng.uniform(2.0, 3.5, 20))
    terms = [(a, b, 0, 0) for a in range(4) for b in range(4 - a) if a + b]
    lens = bf.PolynomialDistortion(f_terms=terms, g_terms=terms)
    scale = np.array([(0.5 * size) ** -(a + b) for a, b, _, _ in terms])
    theta = 0.7 * rng.standard_normal(2 * len(terms)) * np.tile(scale, 2)
    sources = bf.SourceCatalog(np.append(x, few[0]), np.append(y, few[1]), flux)
    detector, psf = bf.Detector((size, size), pixel="box"), bf.MoffatPSF(fwhm, 3.0)
    light = bf.ForwardModel(detector, sources, psf, lens).expected_counts(theta)
    v, u = np.mgrid[:size, :size] / size - 0.5
    counts = rng.poisson(light + 150.0 + 40.0 * u - 30.0 * v**2).astype(float)
    row, column = rng.integers(0, size, (2, hot))
    counts[row, column] += 10.0 ** rng.uniform(2.0, 4.5, hot)
    stored = np.rint(counts / GAIN + rng.normal(0.0, NOISE / GAIN, counts.shape) + PEDESTAL)
    fits.PrimaryHDU(stored.clip(0, 65535).astype(np.uint16)).writeto(folder / "camera.fits")
    np.savetxt(folder / "camera.csv", np.c_[x, y], delimiter=",", header="x,y", comments="")
    return dict(zip(lens.names, theta, strict=True))


@pytest.mark.parametrize("fwhm", [1.4, 3.0, 6.0])
def test_hot_pixels_are_no_stars(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fwhm: float
) -> None:
    monkeypatch.chdir(tmp_path)
    camera(tmp_path, fwhm)
    assert invoke("camera.fits")[0] == 0
    run = read_settings(tmp_path / "camera.toml")
    width = np.hypot(fwhm / 2.3548, 12.0**-0.5)  # the pixel's with it
    assert 0.8 * width < run.psf.sigma < 1.3 * width
    assert run.nuisances.footprint > 2.0 * fwhm


@pytest.mark.parametrize(
    ("grows", "n", "proposed"),
    [(0.0, 26, (0, 0)), (0.0, 14, (0, 0)), (0.1, 26, (0, 7)), (0.3, 14, (2, 0)), (0.3, 5, (0, 0))],
)
def test_a_psf_that_varies_is_proposed_where_images_widen_outward(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, grows: float, n: int, proposed: tuple[int, int]
) -> None:
    """Of n x n vignetted pinholes, a few of them saturated; of 25 nothing can be said."""
    monkeypatch.chdir(tmp_path)
    rng, size, grid = np.random.default_rng(n), 16 * n, 16.0 * (np.arange(n) - 0.5 * (n - 1))
    x, y = (each.ravel() + rng.uniform(-2.0, 2.0, n * n) for each in np.meshgrid(grid, grid))
    outward = 2.0 * np.hypot(x, y) / size
    flux = 10.0 ** rng.uniform(4.0, 5.5, x.size) * (1.0 - 0.4 * outward**2)
    rings, light = np.round(5.0 * outward).astype(int), np.full((size, size), 50.0)
    for ring in np.unique(rings):
        own = bf.SourceCatalog(*(column[rings == ring] for column in (x, y, flux)))
        psf = bf.MoffatPSF(2.0 * (1.0 + grows * (ring / 5.0) ** 2), 3.0)
        lens = bf.PolynomialDistortion([(1, 0, 0, 0)], [])
        model = bf.ForwardModel(bf.Detector((size, size), pixel="box"), own, psf, lens)
        light += model.expected_counts([0.0], 0.0)
    counts = np.minimum(np.round(rng.poisson(light) / 1.5 + 200.0), 16383.0)
    fits.PrimaryHDU(counts.astype(np.uint16)).writeto("night.fits")
    assert invoke("night.fits")[0] == 0
    psf_settings = read_settings(tmp_path / "night.toml").psf
    assert (psf_settings.degree, psf_settings.nodes) == proposed


@pytest.mark.slow
@pytest.mark.parametrize("fwhm", [1.4, 3.0])
def test_what_is_proposed_fits_a_strangers_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fwhm: float
) -> None:
    """Fits, and is right within its errors: chi-square of 18 degrees of freedom has p = 1e-4 at 49.

    The same run file with a Gaussian PSF does not fit.
    """
    monkeypatch.chdir(tmp_path)
    truth = camera(tmp_path, fwhm)
    assert invoke("camera.fits")[0] == 0
    done = CliRunner().invoke(app, ["fit", "camera.toml", "--map-only"])
    assert done.exit_code == 0 and "\ntrustworthy:" in done.stdout
    chain = bf.open_chain("chains/camera.h5")
    own = [chain.parameter_names.index(name) for name in truth]
    draws = chain.draws()[:, own]
    off = draws.mean(axis=0) - list(truth.values())
    assert off @ np.linalg.solve(np.cov(draws.T), off) < 49.0
    text = Path("camera.toml").read_text()
    text = re.sub('kind = "measured".*', "", text).replace("model_error = true", "psf_sigma = true")
    Path("gaussian.toml").write_text(text)
    done = CliRunner().invoke(app, ["fit", "gaussian.toml", "--map-only"])
    assert done.exit_code == 3 and "does not fit the counts" in done.stdout


@pytest.mark.slow
def test_a_frame_without_footprints_is_matched_among_hot_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The brightest peaks are hot pixels, which the search matched to the catalogue."""
    monkeypatch.chdir(tmp_path)
    truth = camera(tmp_path, 3.0, n=5, hot=300)
    assert invoke("camera.fits")[0] == 0
    text = Path("camera.toml").read_text()
    Path("camera.toml").write_text(re.sub("footprint = .*", "", text))
    done = CliRunner().invoke(app, ["fit", "camera.toml", "--map-only"])
    chain = bf.open_chain("chains/camera.h5")
    draws = chain.draws()[:, [chain.parameter_names.index(name) for name in truth]]
    off = draws.mean(axis=0) - list(truth.values())
    assert off @ np.linalg.solve(np.cov(draws.T), off) < 49.0
    number = re.search(r"hot pixels or cosmic rays: (\d+) pixels at row, column", done.stdout)
    assert number is not None and 220 <= int(number[1]) <= 300

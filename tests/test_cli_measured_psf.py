"""`[psf] kind = "measured"`: a frame whose PSF is measured on it, and one that takes it over."""

import csv
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from test_cli import Output, assert_refused, invoke

import bayesfred as bf
from bayesfred.analysis.verify import verify
from bayesfred.commands import pipeline
from bayesfred.errors import InputError
from bayesfred.sampling.chainfile import open_chain

pytestmark = pytest.mark.slow

RUN = """
[frame]
path = "{frame}"

[catalogue]
path = "stars.csv"

[detector]
pixel = "box"

[psf]
{psf}

[distortion]
terms = "polynomial"
degree = 1

[nuisances]
flux = "free"
offset = true

[output]
path = "{output}"
"""
MEASURED = 'kind = "measured"\nsigma = 1.1'
THETA = np.array([1e-3, -5e-4, 3e-4, 8e-4])


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames of one camera, whose PSF is no Gaussian, with one catalogue."""
    folder = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(1)
    grid = bf.SourceCatalog.grid(6, 18.0, 1e5)
    jitter = rng.uniform(-0.5, 0.5, (2, len(grid)))
    sources = bf.SourceCatalog(grid.x + jitter[0], grid.y + jitter[1], grid.flux)
    model = bf.ForwardModel(
        bf.Detector((127, 127), pixel="box"), sources, bf.MoffatPSF(2.6, 3.5),
        bf.PolynomialDistortion.polynomial(1),
    )  # fmt: skip
    for name, seed in (("one", 1), ("two", 2)):
        np.save(folder / f"{name}.npy", bf.simulate(model, THETA, 20.0, seed=seed))
    with open(folder / "stars.csv", "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["x", "y", "flux"])
        rows.writerows(zip(sources.x, sources.y, sources.flux, strict=True))
    (folder / "one.toml").write_text(
        RUN.format(frame="one.npy", psf=MEASURED, output="one.h5"), encoding="utf-8"
    )
    file_psf = 'kind = "file"\npath = "one.psf.fits"'
    (folder / "two.toml").write_text(
        RUN.format(frame="two.npy", psf=file_psf, output="two.h5"), encoding="utf-8"
    )
    return folder


@pytest.fixture(scope="module")
def fitted(frames: Path) -> tuple[Path, Output]:
    """What a fit of the first frame left and printed."""
    return frames, invoke(frames, "fit", "one.toml", "--map-only")


def test_a_measured_psf_makes_the_fit_trustworthy(fitted: tuple[Path, Output]) -> None:
    folder, output = fitted
    assert output.code == 0, output.stdout + output.stderr
    assert "psf: measured, FWHM" in output.stdout
    assert output.stdout.splitlines()[-1].startswith("trustworthy: ")
    names = {path.name for path in folder.iterdir()}
    assert {"one.h5", "one.html", "one.psf.fits"} <= names
    assert "Point spread function" in (folder / "one.html").read_text(encoding="utf-8")
    chain = open_chain(folder / "one.h5")
    estimate = chain.estimate
    z = (estimate.params[:4] - THETA) / np.sqrt(np.diag(estimate.covariance))[:4]
    assert np.all(np.abs(z) < 4.0)
    assert all(check.holds for check in verify(folder / "one.h5"))


def test_the_psf_file_is_the_chains_psf(fitted: tuple[Path, Output]) -> None:
    folder, _ = fitted
    psf = open_chain(folder / "one.h5").posterior().model.psf
    read = bf.MeasuredPSF.read(folder / "one.psf.fits")
    np.testing.assert_allclose(read.coefficients, psf.coefficients, rtol=1e-14)
    np.testing.assert_allclose(read.draws, psf.draws, rtol=1e-14)
    x = np.arange(-3, 4) / psf.oversampling
    with fits.open(folder / "one.psf.fits", checksum=True) as file:
        middle = len(file[0].data) // 2
        near = slice(middle - 3, middle + 4)
        np.testing.assert_allclose(file[0].data[near, near], psf.density(x, x[:, None]), rtol=1e-12)


def test_another_frame_takes_it_over_with_its_errors(fitted: tuple[Path, Output]) -> None:
    folder, _ = fitted
    output = invoke(folder, "fit", "two.toml", "--map-only")
    assert output.code == 0, output.stdout + output.stderr
    assert "psf: measured on another frame" in output.stdout
    chain = open_chain(folder / "two.h5")
    errors = chain.posterior().psf_errors
    assert errors is not None and errors.absorbed == 0.0
    known = chain.estimate.covariance - errors.covariance
    assert np.all(np.diag(errors.covariance) > 0.0) and np.all(np.diag(known) > 0.0)
    spread = chain.draws().var(axis=0) / np.diag(chain.estimate.covariance)
    np.testing.assert_allclose(spread, 1.0, rtol=0.2)  # 1,000 draws know a variance to 4.5 %


def test_a_damaged_psf_file_is_refused(fitted: tuple[Path, Output], tmp_path: Path) -> None:
    folder, _ = fitted
    content = bytearray((folder / "one.psf.fits").read_bytes())
    content[len(content) // 2] ^= 1
    for name in ("two.npy", "stars.csv", "two.toml"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "one.psf.fits").write_bytes(content)
    assert_refused(invoke(tmp_path, "fit", "two.toml"), "one.psf.fits", "damaged")
    (tmp_path / "one.psf.fits").write_bytes(b"no image")
    assert_refused(invoke(tmp_path, "fit", "two.toml"), "one.psf.fits", "damaged")


def test_a_psf_that_nobody_asked_to_replace_stays(fitted: tuple[Path, Output]) -> None:
    folder, _ = fitted
    before = (folder / "one.psf.fits").read_bytes()
    assert_refused(invoke(folder, "report", "one.h5"), "--overwrite")
    with pytest.raises(bf.InputError, match="exists"):
        bf.MeasuredPSF.read(folder / "one.psf.fits").write(folder / "one.psf.fits")
    assert (folder / "one.psf.fits").read_bytes() == before


@pytest.mark.parametrize(
    ("psf", "said"),
    [
        ('kind = "measured"', "sigma: missing"),
        ('kind = "measured"\nsigma = 1.0\noversampling = 0', "oversampling: got 0"),
        ('kind = "measured"\nsigma = 1.0\ndegree = 9', "degree: got 9"),
        ('kind = "file"', "path: missing"),
    ],
)
def test_bad_choices_are_refused(frames: Path, tmp_path: Path, psf: str, said: str) -> None:
    for name in ("one.npy", "stars.csv"):
        (tmp_path / name).write_bytes((frames / name).read_bytes())
    (tmp_path / "bad.toml").write_text(
        RUN.format(frame="one.npy", psf=psf, output="bad.h5"), encoding="utf-8"
    )
    assert_refused(invoke(tmp_path, "fit", "bad.toml"), "bad.toml", said)


def test_a_file_of_a_psf_between_nodes_is_refused(frames: Path, tmp_path: Path) -> None:
    """Its draws do not hold the errors of the nodes."""
    x = np.arange(-12, 13) / 4.0
    round_one = np.exp(-0.5 * (x**2 + x[:, None] ** 2))
    c = np.concatenate([round_one[None], np.zeros((4, 25, 25))])
    bf.MeasuredPSF(c, 4.0, 64.0, nodes=2, draws=c[None, :1]).write(tmp_path / "nodes.fits")
    for name in ("one.npy", "stars.csv"):
        (tmp_path / name).write_bytes((frames / name).read_bytes())
    (tmp_path / "run.toml").write_text(
        RUN.format(frame="one.npy", psf='kind = "file"\npath = "nodes.fits"', output="run.h5"),
        encoding="utf-8",
    )
    said = "run.toml: psf: got one that varies between 2 x 2 nodes"
    assert_refused(invoke(tmp_path, "fit", "run.toml"), said)


def test_photutils_renders_the_same_psf() -> None:
    photutils = pytest.importorskip("photutils.psf")
    x = np.arange(-20, 21) / 4.0
    c = np.exp(-(x**2 + 1.3 * x[:, None] ** 2 + 0.3 * x * x[:, None]) / 2)
    psf = bf.MeasuredPSF(c[None], 4.0, 100.0)
    model = psf.to_photutils()
    assert isinstance(model, photutils.ImagePSF)
    at = np.array([0.13, -0.4, 1.1]), np.array([0.2, 0.7, -1.6])
    np.testing.assert_allclose(model(*at), psf.density(*at), atol=1e-4 * psf.peak)
    tilted = bf.MeasuredPSF(np.stack([c, 0.2 * c * x, 0.1 * c * x[:, None]]), 4.0, 50.0)
    gridded = tilted.to_photutils((61, 81))
    gridded.x_0, gridded.y_0 = 70.0, 12.0
    place = (70.0 - 40.0, 12.0 - 30.0)
    values = gridded(70.0 + at[0], 12.0 + at[1])
    np.testing.assert_allclose(values, tilted.density(*at, at=place), atol=1e-3 * psf.peak)
    with pytest.raises(bf.InputError, match="shape"):
        tilted.to_photutils()


def test_where_no_psf_is_found_other_causes_are_told(
    frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The corners are dark, and the search for a PSF does not end."""

    def refuse(*given: object, **named: object) -> None:
        raise InputError("psf: no PSF found in 40 turns")

    monkeypatch.setattr(pipeline, "measure_psf", refuse)
    v, u = np.indices((127, 127)) - 63.0
    dark = np.where(np.hypot(u, v) < 70.0, 1.0, 0.05) * np.load(frames / "one.npy")
    np.save(frames / "corners.npy", np.round(dark))
    text = RUN.format(frame="corners.npy", psf=MEASURED, output="corners.h5")
    (frames / "corners.toml").write_text(text, encoding="utf-8")
    output = invoke(frames, "fit", "corners.toml", "--map-only")
    said = "no PSF found in 40 turns. Or it is the background: "
    assert_refused(output, said, "mask what is not background")


def test_dark_marks_are_told_before_the_fit(frames: Path) -> None:
    counts = np.load(frames / "one.npy")
    np.save(frames / "marks.npy", np.maximum(counts.max() + 1e3 - counts, 0.0))
    text = RUN.format(frame="marks.npy", psf="sigma = 1.5", output="marks.h5")
    (frames / "marks.toml").write_text(text, encoding="utf-8")
    output = invoke(frames, "fit", "marks.toml", "--map-only")
    assert output.code == 3
    assert "the marks are darker than the ground" in output.stdout

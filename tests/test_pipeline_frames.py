"""From a run file and a real frame to a posterior: what the frame says of itself is used."""

import re
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

import bayesfred as bf
from bayesfred.commands import pipeline
from bayesfred.settings.run import read_settings

RUN = """
[frame]
path = "frame.fits"
[catalogue]
path = "stars.csv"
[psf]
sigma = 2.0
[distortion]
f_terms = [[1, 0, 0, 0]]
g_terms = [[0, 1, 0, 0]]
"""
GAIN = 2.0


def write(folder: Path, extra: str = "", **cards: float) -> Path:
    """A run file, its catalogue, and its frame in adu: 25 stars of 10,000 electrons."""
    sources = bf.SourceCatalog.grid(5, 20.0, 1e4)
    distortion = bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
    model = bf.ForwardModel(bf.Detector((120, 120)), sources, bf.GaussianPSF(2.0), distortion)
    counts = bf.simulate(model, [1e-3, -1e-3], 50.0, seed=1)
    header = fits.Header({"BUNIT": "adu", "GAIN": GAIN, **cards})
    fits.PrimaryHDU(counts / GAIN, header).writeto(folder / "frame.fits")
    rows = (f"{x},{y},10000\n" for x, y in zip(sources.x, sources.y, strict=True))
    (folder / "stars.csv").write_text("x,y,flux\n" + "".join(rows))
    (folder / "run.toml").write_text(RUN + extra)
    return folder / "run.toml"


@pytest.mark.parametrize(
    ("extra", "read_noise", "said"),
    [
        ("", 5.0, "read noise: 5 e-, from the header"),
        ("[noise]\nread_noise = 5.0", 5.0, ""),
        ("[noise]\nread_noise = 3.0", 3.0, "read noise: 5 e- of the header not used"),
        ('[noise]\nkind = "gaussian"\nvariance = 60.0', None, "read noise: 5 e- of the header not"),
    ],
)
def test_read_noise_of_the_header(
    tmp_path: Path, extra: str, read_noise: float | None, said: str
) -> None:
    run = write(tmp_path, extra, RDNOISE=5.0)
    posterior, _, notes = pipeline.read_frame(read_settings(run), run, None)
    assert getattr(posterior.noise, "read_noise", None) == read_noise
    assert any(said in note for note in notes)
    assert said or not any("read noise" in note for note in notes)
    assert "gain 2 (GAIN)" in notes[0]
    np.testing.assert_allclose(np.median(posterior.counts), 50.0, atol=2.0)


@pytest.mark.parametrize(
    ("kind", "sigma", "said"),
    [
        ("measured", 0.5, True),
        ("measured", 7.0, True),
        ("measured", 1.2, False),  # near enough
        ("gaussian", 0.5, False),  # not a start, but what the user says
    ],
)
def test_a_far_off_start_of_a_psf_to_measure_is_not_used(
    tmp_path: Path, kind: str, sigma: float, said: bool
) -> None:
    """From a quarter of the width no PSF is found, after minutes."""
    run = write(tmp_path)
    frame = tmp_path / "frame.fits"
    with fits.open(frame) as hdus:
        stored, header = np.array(hdus[0].data), hdus[0].header
    stored[tuple(np.random.default_rng(2).integers(0, 120, (2, 40)))] += 3000.0  # hot pixels
    fits.PrimaryHDU(stored, header).writeto(frame, overwrite=True)
    run.write_text(run.read_text().replace("sigma = 2.0", f'kind = "{kind}"\nsigma = {sigma}'))
    (tmp_path / "stars.csv").unlink()  # the start is known before
    lines: list[str] = []
    with pytest.raises(bf.InputError, match=r"stars\.csv"):
        pipeline.read_frame(read_settings(run), run, lines.append)
    found = re.findall(r"the brightest images, (\S+) pixels, which", "".join(lines))
    assert len(found) == said and np.allclose(list(map(float, found)), 2.0, rtol=0.15), lines


@pytest.mark.slow
@pytest.mark.parametrize("most", [0.4, -1.0])
def test_a_measured_psf_does_not_hide_that_most_sources_were_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: float
) -> None:
    """The search after it rejects nothing itself. Here no share of the sources is few enough."""
    run = write(tmp_path, '[nuisances]\nflux = "free"')
    text = run.read_text().replace("sigma = 2.0", 'kind = "measured"\nsigma = 2.0')
    run.write_text(text.replace("[frame]", "[frame]\nreject_outliers = true"))
    monkeypatch.setattr(pipeline, "BREAKDOWN", most)
    _, estimate, _ = pipeline.read_frame(read_settings(run), run, None)
    assert estimate is not None and estimate.at_maximum
    assert estimate.fits_data == (most > 0.0)
    assert ("over 40 % of the sources" in estimate.message) == (most < 0.0)


def test_free_fluxes_need_no_column(tmp_path: Path) -> None:
    run = write(tmp_path, '[nuisances]\nflux = "free"')
    _, estimate = fitted(run)
    lines = (tmp_path / "stars.csv").read_text().splitlines()
    (tmp_path / "stars.csv").write_text("\n".join(line.rsplit(",", 1)[0] for line in lines))
    posterior, _, notes = pipeline.read_frame(read_settings(run), run, None)
    assert "without fluxes, which are free and begin at" in notes[1]
    # to the scatter of the brightest of noisy peaks
    np.testing.assert_allclose(posterior.model.sources.flux, 1e4, rtol=0.1)
    found = bf.find_map(posterior)
    sd = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(found.params - estimate.params) < 0.05 * sd)
    # negative control: fluxes that are not free are needed, and so is a column that was asked for
    for extra in ('flux = "scale"', 'flux = "fixed"'):
        (tmp_path / "run.toml").write_text(RUN + f"[nuisances]\n{extra}")
        with pytest.raises(bf.InputError, match="got no column 'flux', expected one of: 'x', 'y'"):
            fitted(run)
    asked = RUN.replace('"stars.csv"', '"stars.csv"\nflux = "F"') + '[nuisances]\nflux = "free"'
    (tmp_path / "run.toml").write_text(asked)
    with pytest.raises(bf.InputError, match="got no column 'F'"):
        fitted(run)


def fitted(run: Path) -> tuple[bf.Posterior, bf.MapEstimate]:
    posterior, _, _ = pipeline.read_frame(read_settings(run), run, None)
    return posterior, bf.find_map(posterior)


def test_a_source_that_does_not_fit_is_left_out(tmp_path: Path) -> None:
    """One whose catalogue entry is 0.2 pixels off, which no peak of the residuals shows."""
    run = write(tmp_path, '[nuisances]\nflux = "free"')
    stars = tmp_path / "stars.csv"
    stars.write_text(stars.read_text().replace("\n0.0,0.0,", "\n0.2,0.0,"))
    for rejecting, masked in ("", 0), ("reject_outliers = true\n", 1):
        run.write_text(run.read_text().replace("[frame]\n", "[frame]\n" + rejecting))
        kept, estimate, notes = pipeline.read_frame(read_settings(run), run, None)
        line = "1 of 25 sources do not fit and are left out: rows of the catalogue, from 0: 12"
        assert sum(note.startswith(line) for note in notes) == masked
        assert kept.mask[60, 60] == (not masked)
        assert kept.mask[60, 80]
    assert estimate is not None
    assert estimate.fits_data

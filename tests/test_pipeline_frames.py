"""From a run file and a real frame to a posterior: what the frame says of itself is used."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

import bayesfred as bf
from bayesfred import pipeline
from bayesfred.settings import read_settings

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

"""The verdict is the same wherever it is shown, and real frames get the right cause."""

import csv
import html
import re
from pathlib import Path

import pytest
from test_cli import DATA, ROOT, invoke

import bayesfred as bf

VIMOS = """
[frame]
path = "vimos_pinholes_q2.fits"
gain = 15.0                  # by local variance
[catalogue]
path = "{catalogue}"
[psf]
sigma = 1.7
[distortion]
terms = "polynomial"
degree = 3
[nuisances]
flux = "free"
offset = true
psf_sigma = true
background_order = 2
footprint = 8.0
"""


def test_outputs_agree(tmp_path: Path) -> None:
    """Terminal, page, table and record; of a frame with a fault, fitted without sampling."""
    example = (ROOT / "bayesfred" / "settings" / "example.toml").read_text()
    example = example.replace("shape = [505, 505]", "shape = [161, 161]").replace(
        "side = 9", "side = 5"
    )
    example = example.replace("spacing = 50.0", "spacing = 25.0").replace(
        "sigma = 10.0 ", "sigma = 3.0 "
    )
    run_file = tmp_path / "run.toml"
    run_file.write_text(example)
    assert invoke(tmp_path, "simulate", "run.toml").code == 0
    run_file.write_text(example.replace("sigma = 3.0 ", "sigma = 3.6 "))
    output = invoke(tmp_path, "fit", "run.toml", "--map-only")
    last = output.stdout.strip().splitlines()[-1]
    assert output.code == 3 and last.startswith("not trustworthy: The model does not fit the ")
    assert "Probable cause: PSF" in last and "The error bars leave out" in last
    chain = bf.open_chain(tmp_path / "chains" / "run.h5")
    found = bf.diagnose(chain)
    assert found.message == last and found.causes[0].name == "PSF"
    assert dict(found.summary(chain).meta) == found.verdict
    page = html.unescape((tmp_path / "chains" / "run.html").read_text())
    assert last in page


def need(name: str) -> None:
    if not (DATA / name).is_file():
        pytest.skip("no real frames: BAYESFRED_DATA does not name their folder")


@pytest.mark.long
def test_a_star_tracker_fitted_with_a_gaussian_blames_the_psf(tmp_path: Path) -> None:
    """Its stars are narrower than two pixels and no Gaussians."""
    need("startracker_alt60_azi45.fits")
    example = (ROOT / "examples" / "startracker.toml").read_text()
    gaussian, found = re.subn('kind = "measured".*\n|model_error = true.*\n', "", example)
    assert found == 2
    (tmp_path / "run.toml").write_text(gaussian)
    output = invoke(tmp_path, "fit", "run.toml", "--map-only", data=DATA)
    assert output.code == 3
    assert "Probable cause: PSF" in output.stdout.strip().splitlines()[-1]


@pytest.mark.long
def test_a_pinhole_mask_fitted_with_a_gaussian_blames_the_psf(tmp_path: Path) -> None:
    """The instrument is defocused: the pinholes are cat's eyes."""
    need("vimos_pinholes_q2.fits")
    with (DATA / "vimos_pinholes_q2.csv").open(newline="") as file:
        rows = [[row["x"], row["y"], "180000"] for row in csv.DictReader(file)]
    with (tmp_path / "pinholes.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["x", "y", "flux"], *rows])
    (tmp_path / "vimos.toml").write_text(VIMOS.format(catalogue="pinholes.csv"))
    output = invoke(tmp_path, "fit", "vimos.toml", "--map-only", data=DATA)
    assert output.code == 3
    assert "Probable cause: PSF" in output.stdout.strip().splitlines()[-1]

"""Four real frames of one lens, from FITS and RA/Dec to headers that agree with centroids."""

import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from test_cli import snapshot

import bayesfred as bf
from bayesfred.analysis.frame_estimates import frame_estimates

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"


@pytest.mark.long
def test_four_frames_of_one_lens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two and a half minutes. Centroids are least-squares Gaussians, which know nothing of fits."""
    if not (DATA / "startracker_alt60_azi45_sky.csv").exists():
        pytest.skip("needs the star tracker's frames")
    monkeypatch.setattr(sys, "path", [str(ROOT / "examples"), *sys.path])
    monkeypatch.setenv("BAYESFRED_DATA", str(DATA))
    monkeypatch.chdir(tmp_path)
    before = snapshot(DATA)
    import startracker_sky as example

    found = [example.calibrate(name) for name in example.FRAMES]
    for each in found:
        assert each.stars >= 30
        assert each.rms < 0.12
        assert each.bright >= 4
        assert each.bright_rms < 0.07 + 2.0 * 0.07 / (2 * each.bright * 2) ** 0.5
        assert each.truncation < 1e-3
    mean, sd, p = example.agreement(found)
    assert p > 0.01
    assert abs(mean - 0.54) < 3.0 * (sd**2 + 0.02**2) ** 0.5  # of centroids, all eight frames
    for name in example.FRAMES:
        header = fits.getheader(tmp_path / "chains" / f"startracker_sky_{name}.header.fits")
        assert header["CTYPE1"] == "RA---TAN-SIP"
    assert snapshot(DATA) == before


@pytest.mark.long
def test_four_frames_give_one_posterior_of_the_lens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Six minutes. Errors of the cubic terms are less than the frames' own combined term by term:
    what the frames share beside a term is known better, too."""
    if not (DATA / "startracker_alt60_azi45_sky.csv").exists():
        pytest.skip("needs the star tracker's frames")
    monkeypatch.setattr(sys, "path", [str(ROOT / "examples"), *sys.path])
    monkeypatch.setenv("BAYESFRED_DATA", str(DATA))
    monkeypatch.chdir(tmp_path)
    import startracker_sky as example

    found = bf.commands.fit(ROOT / "examples" / "startracker_joint.toml", map_only=True)
    chain, names = found.chain, found.chain.parameter_names
    radial, sd = example.radial_cubic(chain)
    assert abs(radial - 0.54) < 3.0 * (sd**2 + 0.02**2) ** 0.5  # of centroids, all eight frames
    each = frame_estimates(chain)
    cubic = [names.index(name) for name in example.CUBIC]
    combined = np.sum(each.sd[:, cubic] ** -2, axis=0) ** -0.5
    assert np.all(each.joint_sd[0, cubic] < combined)
    assert found.diagnostics.agreement is not None and found.diagnostics.agreement.agree
    pages = {path.name for path in (tmp_path / "chains").glob("*.html")}
    own = {f"startracker_joint.{name}.html" for name in example.FRAMES}
    assert pages == {"startracker_joint.html", *own}

"""A frame of a symmetric catalogue on the sky, from run file to verdict."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from test_cli import invoke

import bayesfred as bf
from bayesfred.commands import joint_pipeline, pipeline
from bayesfred.io.tangent_plane import TangentPlane
from bayesfred.settings.joint import JointRun, read_run
from bayesfred.settings.run import read_settings

SCALE = 30.0 / 3600.0
ANGLE = 160.0
RUN = """
[frame]
path = "frame.fits"
[catalogue]
path = "stars.csv"
ra = "ra"
dec = "dec"
[sky]
pointing = [180.01, 20.0]
pixel_scale = 30.5
[psf]
sigma = 2.0
[distortion]
terms = "polynomial"
degree = 2
[nuisances]
flux = "free"
offset = true
[output]
path = "run.h5"
"""
GUESS = "pointing = [180.01, 20.0]\npixel_scale = 30.5"
GIVEN = f'{GUESS}\nposition_angle = {ANGLE + 2.0}\nparity = "sky"'
SYMMETRIC = "but the catalogue is symmetric, and its stars fit the frame as well at position angle"


def plane(angle: float) -> TangentPlane:
    sin, cos = SCALE * np.sin(np.radians(angle)), SCALE * np.cos(np.radians(angle))
    return TangentPlane(180.0, 20.0, ((-cos, sin), (sin, cos)))


TRUTH = plane(ANGLE)


def write(folder: Path, *, flux: object = 3e4, header: TangentPlane | None = None) -> Path:
    """A frame of 6 x 5 stars of a regular grid, turned by 160 degrees, and its run file."""
    y, x = (np.mgrid[:5, :6].reshape(2, -1) - [[2.0], [2.5]]) * 30.0
    ra, dec = plane(0.0).to_sky(x, y)
    light = np.broadcast_to(np.asarray(flux, dtype=np.float64), ra.shape)
    sources = bf.SourceCatalog(*TRUTH.to_plane(ra, dec), light)
    lens = bf.PolynomialDistortion([(2, 0, 0, 0)], [(1, 1, 0, 0)])
    model = bf.ForwardModel(bf.Detector((200, 220)), sources, bf.GaussianPSF(2.0), lens)
    cards = fits.Header()
    if header is not None:
        cards.update({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": 110.5, "CRPIX2": 100.5})
        cards.update({"CRVAL1": header.ra, "CRVAL2": header.dec})
        for i in (0, 1):
            cards.update({f"CD{i + 1}_{j + 1}": header.matrix[i][j] for j in (0, 1)})
    counts = bf.simulate(model, [2e-5, -2e-5], 10.0, seed=1)
    fits.PrimaryHDU(counts, cards).writeto(folder / "frame.fits")
    rows = (f"{a!r},{d!r},{f!r}\n" for a, d, f in np.stack([ra, dec, light], axis=1).tolist())
    (folder / "stars.csv").write_text("ra,dec,flux\n" + "".join(rows))
    (folder / "run.toml").write_text(RUN)
    return folder / "run.toml"


def read(run: Path, sky: str = GUESS) -> tuple[TangentPlane, bf.MapEstimate | None, list[str]]:
    run.write_text(RUN.replace(GUESS, sky))
    posterior, estimate, notes = pipeline.read_frame(read_settings(run), run, None)
    assert posterior.model.sources.sky is not None
    return posterior.model.sources.sky, estimate, notes


def off(found: TangentPlane) -> float:
    """The largest distance from the true plane over the frame, pixel."""
    u, v = np.meshgrid([-110.0, 0.0, 110.0], [-100.0, 0.0, 100.0])
    x, y = found.to_plane(*TRUTH.to_sky(u, v))
    return float(np.hypot(x - u, y - v).max())


def test_a_symmetric_catalogue_is_not_trusted(tmp_path: Path) -> None:
    run = write(tmp_path)
    _, estimate, notes = read(run)
    assert estimate is not None and estimate.at_maximum and not estimate.fits_data
    assert SYMMETRIC in estimate.message and "sky.position_angle" in estimate.message
    assert SYMMETRIC in notes[1]
    # negative control: whoever gives the orientation is told of no other
    found, estimate, notes = read(run, GIVEN)
    assert estimate is None and not any(SYMMETRIC in note for note in notes)
    assert off(found) < 1.0


def test_fluxes_tell(tmp_path: Path) -> None:
    run = write(tmp_path, flux=3e4 * np.random.default_rng(2).lognormal(0.0, 0.5, 30))
    found, estimate, notes = read(run)
    assert estimate is None and not any(SYMMETRIC in note for note in notes)
    assert off(found) < 1.0


@pytest.mark.parametrize(("angle", "right"), [(ANGLE - 3.0, True), (ANGLE + 90.0, False)])
def test_a_header_tells_if_it_is_right(tmp_path: Path, angle: float, right: bool) -> None:
    run = write(tmp_path, header=plane(angle))
    found, estimate, _ = read(run, "")
    assert (estimate is None) == right
    assert off(found) < 1.0 or not right


@pytest.mark.slow
def test_the_verdict_and_the_exit_code_say_so(tmp_path: Path) -> None:
    run = write(tmp_path)
    output = invoke(tmp_path, "fit", "run.toml", "--map-only")
    assert output.code == 3, output.stderr
    verdict = output.stdout.splitlines()[-1]
    assert verdict.startswith("not trustworthy: The parameters may be wrong: found,")
    assert SYMMETRIC in verdict
    chain = bf.open_chain(tmp_path / "run.h5")
    diagnostics = bf.diagnose(chain)
    assert not diagnostics.fits_data and SYMMETRIC in diagnostics.message
    # negative control
    run.write_text(RUN.replace(GUESS, GIVEN))
    output = invoke(tmp_path, "fit", "run.toml", "--map-only", "--overwrite")
    assert output.code == 0, output.stderr


@pytest.mark.slow
def test_of_several_frames_the_ambiguous_one_is_named(tmp_path: Path) -> None:
    write(tmp_path)
    known = f"sky = {{ {', '.join(GIVEN.splitlines()[2:])} }}"
    head = RUN.replace('[frame]\npath = "frame.fits"\n', "")
    (tmp_path / "other.fits").write_bytes((tmp_path / "frame.fits").read_bytes())
    frames = '[[frames]]\npath = "frame.fits"\n{}\n[[frames]]\npath = "other.fits"\n{}\n'
    for own, ambiguous in ((("", known), True), ((known, known), False)):
        run_file = tmp_path / "joint.toml"
        run_file.write_text(head + frames.format(*own))
        run = read_run(run_file)
        assert isinstance(run, JointRun)
        _, estimate, _ = joint_pipeline.read_frames(run, run_file, None)
        assert (estimate is not None) == ambiguous
        if estimate is not None:
            assert not estimate.fits_data
            assert f"; frame: {SYMMETRIC}" in estimate.message
            assert f"other: {SYMMETRIC}" not in estimate.message

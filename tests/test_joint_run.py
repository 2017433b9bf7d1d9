"""Run files of several frames: `[[frames]]`, what a fit of them writes, and what is refused.

Three frames of 65 x 65 pixels and 16 sources show one lens, of two terms of degree 2. Each has its
own scales and background, one its own catalogue, and one lies in an HDF5 file.
"""

from __future__ import annotations

import html
import json
import multiprocessing
import re
import shutil
from importlib.util import find_spec
from pathlib import Path

import h5py
import numpy as np
import pytest
from test_cli import Output, assert_refused, invoke, snapshot

import bayesfred as bf
from bayesfred.analysis.frame_agreement import frame_agreement
from bayesfred.analysis.frame_estimates import frame_estimates
from bayesfred.commands import joint_pipeline, pipeline
from bayesfred.commands.joint_pipeline import files_beside
from bayesfred.commands.results import How, Job, make_chain
from bayesfred.io.tables import read_table
from bayesfred.settings.joint import JointRun, read_run
from bayesfred.settings.run import read_settings
from bayesfred.settings.sections import toml

pytestmark = pytest.mark.slow

LENS = {"f_x2": 5e-4, "g_y2": -4e-4}
POSES = {"a": (0.0, 0.0), "b": (1e-3, -2e-3), "c": (2e-3, -4e-3)}
LEVELS = {"a": 3.0, "b": 4.0, "c": 5.0}
SOURCES = bf.SourceCatalog.grid(4, 15.0, 3e4)
DISTORTION = bf.PolynomialDistortion([(1, 0, 0, 0), (2, 0, 0, 0)], [(0, 1, 0, 0), (0, 2, 0, 0)])
MODEL = bf.ForwardModel(bf.Detector((65, 65)), SOURCES, bf.GaussianPSF(2.0), DISTORTION)
RUN = """
[catalogue]
path = "stars.csv"
[psf]
sigma = 2.0
[distortion]
f_terms = [[1, 0, 0, 0], [2, 0, 0, 0]]
g_terms = [[0, 1, 0, 0], [0, 2, 0, 0]]
[sampling]
seed = 3
walkers = 24
target_ess = 200
[output]
path = "run.h5"
[[frames]]
path = "a.npy"
[[frames]]
name = "b"
path = "second.npy"
catalogue = { path = "b.csv", flux = "counts" }
[[frames]]
name = "c"
path = "cube.h5"
frame = { name = "third" }
"""
FILES = {
    "run.h5", "run.html", "run.png", "run.sources.ecsv",
    *(f"run.{name}.{kind}" for name in "abc" for kind in ("html", "png")),
}  # fmt: skip


def frame_of(name: str, lens: dict[str, float]) -> np.ndarray:
    (x, y), (x2, y2) = POSES[name], lens.values()
    return bf.simulate(MODEL, [x, x2, y, y2], LEVELS[name], seed=ord(name))


def write(folder: Path, odd: dict[str, float] = LENS, text: str = RUN) -> Path:
    """The frames, of which c may be of another lens, their catalogues, and the run file."""
    np.save(folder / "a.npy", frame_of("a", LENS))
    np.save(folder / "second.npy", frame_of("b", LENS))
    with h5py.File(folder / "cube.h5", "w") as file:
        file["other"], file["third"] = np.zeros((65, 65)), frame_of("c", odd)
    for name, flux in (("stars", "flux"), ("b", "counts")):
        rows = (f"{x},{y},30000\n" for x, y in zip(SOURCES.x, SOURCES.y, strict=True))
        (folder / f"{name}.csv").write_text(f"x,y,{flux}\n" + "".join(rows))
    (folder / "run.toml").write_text(text)
    return folder / "run.toml"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("inputs")).parent


@pytest.fixture
def folder(inputs: Path, tmp_path: Path) -> Path:
    """A copy of the inputs, to be spoilt."""
    return Path(shutil.copytree(inputs, tmp_path / "here"))


@pytest.fixture(scope="module")
def mapped(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Output]:
    """What a fit without sampling leaves."""
    folder = Path(shutil.copytree(inputs, tmp_path_factory.mktemp("mapped") / "run"))
    return folder, invoke(folder, "fit", "run.toml", "--map-only")


@pytest.fixture(scope="module")
def sampled(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Output]:
    folder = Path(shutil.copytree(inputs, tmp_path_factory.mktemp("sampled") / "run"))
    return folder, invoke(folder, "fit", "run.toml")


def page(folder: Path, name: str = "run.html") -> str:
    return (folder / name).read_text(encoding="utf-8")


def z_scores(chain: bf.Chain) -> np.ndarray:
    truth = dict(LENS)
    for name in "abc":
        truth |= {f"{name}.f_x": POSES[name][0], f"{name}.g_y": POSES[name][1]}
        truth[f"{name}.background"] = LEVELS[name]
    expected = np.array([truth[name] for name in chain.parameter_names])
    return (chain.draws().mean(axis=0) - expected) / chain.draws().std(axis=0)


# --- a fit ----------------------------------------------------------------------------------------


def test_everything_is_written_and_the_verdict_is_of_all_frames(
    mapped: tuple[Path, Output],
) -> None:
    folder, output = mapped
    assert output.code == 0
    new = {path.name for path in folder.iterdir() if not path.name.startswith(".")}
    assert new - {"run.toml", "a.npy", "second.npy", "cube.h5", "stars.csv", "b.csv"} == FILES
    last = output.stdout.splitlines()[-1]
    assert last.startswith("trustworthy: ")
    banner = re.search(r'class="verdict good" role="status">\s*([^<]*)</p>', page(folder))
    assert banner is not None and html.unescape(banner[1]) == last
    for name in ("f_x2", "g_y2", "frame", "deviance z", "agrees", "run.sources.ecsv"):
        assert name in output.stdout
    assert "a: a.npy: 65 x 65 pixels" in output.stdout
    assert "b: b.csv: 16 sources" in output.stdout and "c: stars.csv: 16" in output.stdout


def test_frames_share_the_lens_and_nothing_else(mapped: tuple[Path, Output]) -> None:
    """4.5: of eleven scores, normal if the error bars hold, one in 13,000 sets has a larger one."""
    chain = bf.open_chain(mapped[0] / "run.h5")
    own = ("f_x", "g_y", "background")
    assert chain.parameter_names == (*LENS, *(f"{name}.{each}" for name in "abc" for each in own))
    assert np.abs(z_scores(chain)).max() < 4.5
    # three frames that are alike tell the lens sqrt(3) times better than one, and the rest no
    # better: the 1000 draws give the errors to 2 %
    one = bf.laplace(chain.posterior().frames["a"], seed=1, progress=False)
    names = list(one.parameter_names)
    alone, together = one.draws().std(axis=0), chain.frame("a").draws().std(axis=0)
    for name in names:
        gain = alone[names.index(name)] / together[names.index(name)]
        assert abs(gain / (3**0.5 if name in LENS else 1.0) - 1.0) < 0.1


def test_it_is_the_posterior_of_the_frames_read_one_by_one(
    folder: Path, mapped: tuple[Path, Output]
) -> None:
    frames = {}
    texts = {
        "a": RUN[: RUN.index("[[frames]]")] + '[frame]\npath = "a.npy"',
        "b": '[frame]\npath = "second.npy"\n'
        + RUN[: RUN.index("[[frames]]")].replace('"stars.csv"', '"b.csv"\nflux = "counts"'),
        "c": RUN[: RUN.index("[[frames]]")] + '[frame]\npath = "cube.h5"\nname = "third"',
    }
    for name, text in texts.items():
        (folder / "one.toml").write_text(text)
        run_file = folder / "one.toml"
        frames[name] = pipeline.read_frame(read_settings(run_file), run_file, None)[0]
    joint = bf.JointPosterior(frames)
    chain = bf.open_chain(mapped[0] / "run.h5")
    best = bf.find_map(joint)
    assert chain.posterior().log_prob(best.params) == joint.log_prob(best.params)
    assert np.array_equal(best.params, chain.estimate.params)


def test_pages_lead_to_each_other_and_stand_alone(mapped: tuple[Path, Output]) -> None:
    folder = mapped[0]
    links = re.findall(r'href="([^"#]+)"', page(folder))
    assert links == ["run.a.html", "run.b.html", "run.c.html"]
    for name, link in zip("abc", links, strict=True):
        text = page(folder, link)
        assert re.findall(r'href="([^"#]+)"', text) == ["run.html"]
        assert f"<h1>run: {name}</h1>" in text
        assert "Frame, model and residual" in text and "Settings" not in text
    notes = page(folder, "run.b.html")
    assert "b.csv: 16 sources" in notes and "stars.csv" not in notes
    for text in (page(folder), notes):
        assert not re.search(r"<script|<link|@import|url\(", text)
        assert all(image.startswith("data:") for image in re.findall(r'src="([^"]+)"', text))


def test_one_table_has_the_sources_of_all(mapped: tuple[Path, Output]) -> None:
    folder = mapped[0]
    chain = bf.open_chain(folder / "run.h5")
    table = read_table(folder / "run.sources.ecsv").columns
    assert table["frame"].tolist() == ["a"] * 16 + ["b"] * 16 + ["c"] * 16
    for name in "abc":
        expected = bf.diagnose(chain.frame(name)).sources
        assert set(table) == {"frame", *expected.colnames}
        of_frame = table["frame"] == name
        for key in expected.colnames:
            assert np.array_equal(table[key][of_frame], expected[key], equal_nan=True)


@pytest.mark.long
def test_a_frame_of_another_lens_is_named_in_json(tmp_path: Path) -> None:
    write(tmp_path, odd={"f_x2": 9e-4, "g_y2": -4e-4})
    output = invoke(tmp_path, "fit", "run.toml", "--map-only", "--json")
    record = json.loads(output.stdout)
    assert output.code == 3 and record["trustworthy"] is record["fits_data"] is False
    assert "Frame c does not share what the others share" in record["message"]
    chain = bf.open_chain(tmp_path / "run.h5")
    assert [row["name"] for row in record["parameters"]] == list(chain.parameter_names)
    frames = record["frames"]
    assert {name: own["agrees"] for name, own in frames.items()} == {
        "a": True, "b": True, "c": False,
    }  # fmt: skip
    assert frames["c"]["agreement_p"] < 1e-6 < 1e-4 < frames["a"]["agreement_p"]
    for name, own in frames.items():
        assert (own["sources"], own["pixels"]) == (16, 65 * 65)
        assert own["files"]["report"] == f"run.{name}.html"
        assert [row["name"] for row in own["parameters"]] == list(chain.frame(name).parameter_names)
    assert frames["c"]["deviance_z"] > 5 and frames["c"]["fits_data"] is False
    # each frame alone has its own lens, by one Newton step from the maximum of all
    found = frame_estimates(chain)
    expected = [[5e-4, -4e-4], [5e-4, -4e-4], [9e-4, -4e-4]]
    assert np.abs((found.values - expected) / found.sd).max() < 4.5
    assert np.abs(found.pulls[:, 0]).min() > 10 and np.abs(found.pulls[:, 1]).max() < 4


# --- sampling, and what can be done with the chain ------------------------------------------------


def test_sampling_agrees_with_the_information(
    sampled: tuple[Path, Output], mapped: tuple[Path, Output]
) -> None:
    folder, output = sampled
    assert output.code == 0 and "Sampled well" in output.stdout.splitlines()[-1]
    chain, normal = (bf.open_chain(each[0] / "run.h5") for each in (sampled, mapped))
    assert np.abs(z_scores(chain)).max() < 4.5
    ratio = chain.draws().std(axis=0) / normal.draws().std(axis=0)
    assert np.abs(ratio - 1).max() < 4 * (0.5 / 200 + 0.5 / 1000) ** 0.5
    assert "Traces and rank histograms of 2 parameters" in page(folder)


def test_resumed_steps_are_those_of_a_longer_run(folder: Path) -> None:
    def made(number: int, how: How, more: str = "") -> bf.Chain:
        """A fit as far as the chain file: pages take longer."""
        text = RUN.replace("target_ess = 200", f"steps = {number}") + more
        (folder / "run.toml").write_text(text)
        run = read_run(folder / "run.toml")
        assert isinstance(run, JointRun)
        joint, estimate, notes = joint_pipeline.read_frames(run, folder / "run.toml", None)
        job = Job(run, folder / "run.toml", folder / "run.h5", notes)
        return make_chain(job, joint, estimate, how, beside=(), say=None)

    made(5, How())
    before = snapshot(folder)["run.h5"]
    with pytest.raises(bf.InputError, match="other shared, prior, expected the same"):
        made(9, How(resume=True), '[joint]\nshared = ["f_x2"]')
    assert snapshot(folder)["run.h5"] == before
    resumed = made(9, How(resume=True))
    np.testing.assert_array_equal(resumed.chain, made(9, How(overwrite=True)).chain)
    record = bf.open_chain(folder / "run.h5").record
    assert record is not None and record.frame == "3 frames"
    # what the file keeps of the settings makes the same run
    (folder / "again.toml").write_text(str(record.settings))
    assert read_run(folder / "again.toml") == read_run(folder / "run.toml")
    assert record.notes[0].startswith("a: a.npy: 65 x 65 pixels")


@pytest.mark.long
def test_workers_make_the_same_chain_and_are_gone_afterwards(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    (folder / "run.toml").write_text(RUN.replace("target_ess = 200", "steps = 2"))
    here = bf.commands.fit(folder / "run.toml")
    there = bf.commands.fit(folder / "run.toml", overwrite=True, workers=2)
    np.testing.assert_array_equal(there.chain.chain, here.chain.chain)
    posterior = there.chain.posterior()
    assert isinstance(posterior, bf.JointPosterior)
    start = there.chain.estimate.params
    assert posterior.log_prob(start) == here.chain.posterior().log_prob(start)
    assert not multiprocessing.active_children()


def test_workers_are_refused_where_there_is_nothing_to_share(folder: Path) -> None:
    single = RUN[: RUN.index("[[frames]]")] + '[frame]\npath = "a.npy"\n'
    (folder / "single.toml").write_text(single)
    found = invoke(folder, "fit", "single.toml", "--workers", "2")
    assert_refused(found, "single.toml: got --workers for one frame", "[[frames]]")
    both = invoke(folder, "fit", "run.toml", "--workers", "2", "--scheduler", "tcp://[::1]:1")
    assert_refused(both, "got both --scheduler and --workers")
    nobody = invoke(folder, "fit", "run.toml", "--scheduler", "nonsense://")
    without = find_spec("distributed") is None
    words = "distributed is not installed" if without else "expected a Dask scheduler's address"
    assert_refused(nobody, "--scheduler: ", words)
    assert not (folder / "run.h5").exists()


def test_report_and_verify_need_the_chain_alone(
    sampled: tuple[Path, Output], tmp_path: Path
) -> None:
    shutil.copy(sampled[0] / "run.h5", tmp_path)
    output = invoke(tmp_path, "report", "run.h5", "--corner", "g_y2", "--out", "other.html")
    assert output.code == 0
    assert output.stdout.splitlines()[-1] == sampled[1].stdout.splitlines()[-1]
    expected = {name.replace("run", "other") for name in FILES} - {"other.h5"} | {"run.h5"}
    assert {path.name for path in tmp_path.iterdir()} == expected
    assert "Histograms of 1 parameters" in page(tmp_path, "other.html")
    before = snapshot(tmp_path)
    again = invoke(tmp_path, "report", "run.h5", "--out", "other.html")
    assert_refused(again, "other.html: exists", "--overwrite")
    assert_refused(invoke(tmp_path, "report", "run.h5", "--corner", "a.f_x"), "a.f_x", "f_x2, g_y2")
    assert snapshot(tmp_path) == before
    verified = invoke(tmp_path, "verify", "run.h5")
    assert verified.code == 0 and " no " not in verified.stdout


def test_calibration_of_one_of_the_frames(mapped: tuple[Path, Output], tmp_path: Path) -> None:
    shutil.copy(mapped[0] / "run.h5", tmp_path)
    assert_refused(invoke(tmp_path, "calibration", "run.h5"), "run.h5", "--frame", "a, b, c")
    for wrong in ("d", "../a", ""):
        found = invoke(tmp_path, "calibration", "run.h5", "--frame", wrong)
        assert_refused(found, "run.h5", "a, b, c")
    assert [path.name for path in tmp_path.iterdir()] == ["run.h5"]
    assert invoke(tmp_path, "calibration", "run.h5", "--frame", "b").code == 0
    known = bf.Calibration.read(tmp_path / "run.b.calibration.h5")
    u, v, _ = known.to_image(np.array([20.0]), np.array([-20.0]))
    # u = x - f(x) at the object
    np.testing.assert_allclose(u, 20.0 - (1e-3 * 20 + 5e-4 * 400), atol=0.05)
    np.testing.assert_allclose(v, -20.0 - (-2e-3 * -20 - 4e-4 * 400), atol=0.05)


def test_halves_of_all_frames_agree(folder: Path) -> None:
    output = invoke(folder, "crosscheck", "run.toml", "--json")
    record = json.loads(output.stdout)
    assert output.code == (0 if record["verdict"] == "right" else 3)
    assert 1e-4 < record["coefficients_p"] <= 1.0 and list(record["frames"]) == ["a", "b", "c"]
    (folder / "second.npy").unlink()
    assert_refused(invoke(folder, "crosscheck", "run.toml"), "run.toml", "second.npy")


def test_models_of_several_frames_are_compared(mapped: tuple[Path, Output], tmp_path: Path) -> None:
    """One model shares both terms of the lens, the other one of them."""
    shutil.copy(mapped[0] / "run.h5", tmp_path / "both.h5")
    frames = bf.open_chain(tmp_path / "both.h5").posterior().frames
    bf.laplace(
        bf.JointPosterior(frames, ["f_x2"]), seed=1, path=tmp_path / "one.h5", progress=False
    )
    output = invoke(tmp_path, "compare", "both.h5", "one.h5", "--out", "page.html")
    assert output.code in (0, 3) and "chosen: both.h5" in output.stdout
    assert "3 frames of one instrument; of 11 parameters they share 2" in page(
        tmp_path, "page.html"
    )
    assert "of 13 parameters they share 1" in page(tmp_path, "page.html")


def test_single_frames_have_no_name_to_pick(mapped: tuple[Path, Output], tmp_path: Path) -> None:
    one = mapped[0] / "run.h5"
    bf.laplace(bf.open_chain(one).posterior().frames["a"], seed=1, path=tmp_path / "one.h5")
    assert_refused(invoke(tmp_path, "calibration", "one.h5", "--frame", "a"), "one.h5", "--frame a")


# --- the run file ---------------------------------------------------------------------------------


def settings(folder: Path, text: str) -> JointRun:
    (folder / "settings.toml").write_text(text)
    run = read_run(folder / "settings.toml")
    assert isinstance(run, JointRun)
    return run


def test_a_frame_has_the_files_settings_and_its_own(tmp_path: Path) -> None:
    text = """
    [frame]
    gain = 2.0
    [sky]
    pixel_scale = 40.0
    [catalogue]
    ra = "RA"
    dec = "Dec"
    [psf]
    sigma = 2.0
    [noise]
    read_noise = 5.0
    [distortion]
    terms = "polynomial"
    degree = 3
    [prior.f_x3]
    distribution = "norm"
    scale = 1e-9
    [prior."n-1.background"]
    distribution = "halfnorm"
    [joint]
    shared = ["f_x3", "g_y3"]
    [joint.drift]
    walk = 0.1
    [[frames]]
    path = "nights/n-1.fits.gz"
    time = 3
    catalogue = { path = "one.csv" }
    sky = { pointing = [10.0, 20.0] }
    [[frames]]
    path = "nights/N2.npy"
    time = 4.5
    gain = 1.0
    pedestal = 100.0
    catalogue = { path = "two.csv" }
    sky = { pointing = [30.0, 40.0] }
    psf = { kind = "moffat", fwhm = 3.0, beta = 2.5 }
    [[frames]]
    name = "third"
    path = "nights/N2.h5"
    time = -1
    frame = { name = "three" }
    catalogue = { path = "two.csv" }
    sky = { pointing = [30.0, 40.0] }
    prior = { f_x3 = { scale = 2e-9 } }
    """
    run = settings(tmp_path, text)
    assert list(run.frames) == ["n-1", "N2", "third"]
    one, two, three = run.frames.values()
    assert (one.frame.gain, two.frame.gain, three.frame.gain) == (2.0, 1.0, 2.0)
    assert (two.frame.pedestal, one.frame.pedestal) == (100.0, None)
    assert (one.frame.name, three.frame.name) == (None, "three")
    assert (one.sky.pointing, one.sky.pixel_scale) == ((10.0, 20.0), 40.0)
    assert (two.catalogue.path, two.catalogue.ra) == ("two.csv", "RA")
    assert isinstance(one.psf.make(), bf.GaussianPSF)
    assert two.psf.make() == bf.MoffatPSF(3.0, 2.5)  # another kind takes nothing over
    assert {each.noise.read_noise for each in run.frames.values()} == {5.0}
    assert [each.prior["f_x3"].keywords["scale"] for each in run.frames.values()] == [
        1e-9, 1e-9, 2e-9,
    ]  # fmt: skip
    assert list(run.prior) == ["n-1.background"]
    assert run.times == {"n-1": 3.0, "N2": 4.5, "third": -1.0}
    assert run.joint.drift is not None and run.joint.drift.walk == 0.1
    # what result files keep is a run file of the same run
    assert settings(tmp_path, toml(run)) == run
    assert toml(settings(tmp_path, toml(run))) == toml(run)


def test_the_example_is_of_the_four_frames_that_have_run_files_of_their_own() -> None:
    examples = Path(__file__).parents[1] / "examples"
    run = read_run(examples / "startracker_joint.toml")
    assert isinstance(run, JointRun) and len(run.frames) == 4
    for name, own in run.frames.items():
        assert own == read_settings(examples / f"startracker_sky_{name}.toml")


FIRST = '[[frames]]\npath = "a.npy"\n'
SECOND = 'path = "second.npy"\n'


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "c"\n', 'name = "B"\n', ["frames: got 2 of the name 'b'", "give name"]),
        ('name = "c"\n', 'name = "c.d"\n', ["frames.2.name: got 'c.d'", "letters"]),
        ('name = "c"\n', 'name = "c/../d"\n', ["frames.2.name", "letters"]),
        ('name = "c"\n', 'name = "c\\u001b[1m"\n', [r"frames.2.name: got 'c\x1b[1m'"]),
        ('name = "c"\n', 'name = "-c"\n', ["frames.2.name: got '-c'"]),
        ('name = "c"\n', 'name = "keys"\n', ["frames.2.name: got 'keys'"]),
        ('"a.npy"', '"a.b.npy"', ["frames.0.name: got 'a.b'", "give name"]),
        ('"a.npy"', '"no.npy"', ["got 'no.npy', expected a file at"]),
        (SECOND, 'path = "a.npy"\n', ["frames: got", "as a and as b", "once"]),
        (SECOND, "", ["frames.b.path: missing"]),
        (SECOND, SECOND + "gian = 2.0\n", ["frames.1.gian: unknown key, did you mean 'gain'?"]),
        (SECOND, SECOND + "gain = -2.0\n", ["frames.b.gain: got -2.0"]),
        (SECOND, SECOND + "gain = true\n", ["frames.b.gain: got True"]),
        (SECOND, SECOND + "time = 2024-05-01\n", ["frames.1.time: got '2024-05-01'"]),
        (SECOND, SECOND + "sampling = { seed = 2 }\n", ["frames.1.sampling: unknown key"]),
        (SECOND, SECOND + "noise = 3\n", ["frames.1.noise: got 3, expected a table"]),
        (SECOND, SECOND + 'psf = { kind = "round" }\n', ["frames.b.psf.kind: got 'round'"]),
        ("sigma = 2.0", "sgma = 2.0", ["run.toml: psf.sigma: missing", "; psf.sgma: unknown"]),
        ("[sampling]", '[frame]\npath = "a.npy"\n[sampling]', ["frame.path: got it beside"]),
        ("[sampling]", "[frames]\n[sampling]", ["TOML"]),
        ("f_terms", 'terms = "choose"\n#', ["distortion.terms: got 'choose'"]),
        (FIRST, '[joint]\nshard = ["f_x2"]\n' + FIRST, ["joint.shard: unknown key"]),
        (FIRST, '[joint]\nshared = "f_x2"\n' + FIRST, ["joint.shared: got 'f_x2'"]),
        (FIRST, '[joint]\nshared = ["f_x3"]\n' + FIRST, ["shared: got f_x3", "f_x2"]),
        (FIRST, "[joint.drift]\n" + FIRST, ["frames: got no time of a, b, c"]),
        (FIRST, '[prior."d.f_x"]\ndistribution = "norm"\n' + FIRST, ["d.f_x"]),
        (RUN[RUN.index("[[frames]]") :], "[joint]\n", ["frames: missing"]),
        (RUN[RUN.index("[[frames]]") :], FIRST, ["frames: got", "at least 2"]),
    ],
)
def test_refusals(folder: Path, old: str, new: str, words: list[str]) -> None:
    assert old in RUN
    text = RUN.replace(old, new, 1).replace("target_ess = 200", "steps = 1")
    (folder / "run.toml").write_text(text)
    before = snapshot(folder)
    output = invoke(folder, "fit", "run.toml", "--map-only")
    assert_refused(output, "run.toml", *words)
    assert snapshot(folder) == before


def test_every_mistake_is_said_at_once(folder: Path) -> None:
    text = RUN.replace(SECOND, SECOND + "gain = -2.0\n").replace("sigma = 2.0", "sigma = -2.0")
    (folder / "run.toml").write_text(text.replace('"cube.h5"', "3"))
    output = invoke(folder, "fit", "run.toml")
    assert_refused(output, "psf.sigma: got -2.0", "frames.b.gain: got -2.0", "frames.c.path: got 3")
    assert output.stderr.count("psf.sigma") == 1


def test_nothing_is_read_before_it_is_known_that_all_can_be_written(folder: Path) -> None:
    """A frame takes minutes; its page must not be in the way at the end."""
    (folder / "run.b.html").write_text("precious")
    output = invoke(folder, "fit", "run.toml")
    assert_refused(output, "run.b.html: exists", "--overwrite")
    assert output.stdout == ""
    (folder / "run.b.html").unlink()
    (folder / "run.toml").write_text(RUN.replace('"run.h5"', '"cube.h5"'))
    output = invoke(folder, "fit", "run.toml", "--overwrite")
    assert_refused(output, "cube.h5: got a file that is read")
    assert output.stdout == ""


def test_a_frame_that_cannot_be_used_is_named(folder: Path) -> None:
    np.save(folder / "second.npy", np.full((65, 65), np.nan))
    assert_refused(invoke(folder, "fit", "run.toml"), "second.npy", "frame b")


@pytest.mark.parametrize("command", ["simulate", "design", "study"])
def test_what_is_of_one_frame_says_so(folder: Path, command: str) -> None:
    before = snapshot(folder)
    assert_refused(invoke(folder, command, "run.toml"), "run.toml: frames", "[[frames]]")
    assert snapshot(folder) == before


# --- more than a fit ------------------------------------------------------------------------------


@pytest.mark.long
def test_drift(tmp_path: Path) -> None:
    """The lens of c is another; on a straight line in time it need not be."""
    times = dict(zip("abc", (0.0, 1.0, 3.0), strict=True))
    text = RUN.replace('name = "c"\n', 'name = "c"\ntime = 3.0\n')
    text = text.replace('name = "b"\n', 'name = "b"\ntime = 1.0\n')
    text = text.replace('path = "a.npy"\n', 'path = "a.npy"\ntime = 0.0\n')
    write(tmp_path, text=text + '[joint.drift]\nterms = ["f_x2"]\n')
    for k, name in enumerate("abc"):
        lens = {"f_x2": 5e-4 + 4e-5 * times[name], "g_y2": -4e-4}
        if name == "c":
            with h5py.File(tmp_path / "cube.h5", "a") as file:
                file["third"][...] = frame_of(name, lens)
        else:
            np.save(tmp_path / ("a.npy", "second.npy")[k], frame_of(name, lens))
    output = invoke(tmp_path, "fit", "run.toml", "--map-only")
    assert "f_x2.drift" in output.stdout and "The frames agree about what" in output.stdout
    chain = bf.open_chain(tmp_path / "run.h5")
    assert chain.parameter_names[:3] == ("f_x2", "g_y2", "f_x2.drift")
    draws = chain.draws()[:, [0, 2]]
    z = (draws.mean(axis=0) - [5e-4 + 4e-5 * 4 / 3, 4e-5]) / draws.std(axis=0)
    assert np.abs(z).max() < 4.5
    found = frame_estimates(chain)
    assert found.times is not None and found.times.tolist() == [0.0, 1.0, 3.0]
    assert np.abs(found.pulls).max() < 4.5
    np.testing.assert_allclose(
        np.diff(found.joint[:, 0]), draws.mean(axis=0)[1] * np.diff(found.times), rtol=0.02
    )
    assert ">time</th>" in page(tmp_path)
    # negative control: without a drift the frames do not agree
    still = bf.JointPosterior(chain.posterior().frames)
    assert not frame_agreement(still, bf.find_map(still).params).agree


def test_frames_maxima_are_where_the_search_begins(folder: Path) -> None:
    """Where outliers were rejected each frame's maximum is known, and all need few evaluations."""
    text = RUN.replace("[catalogue]", "[frame]\nreject_outliers = true\n[catalogue]", 1)
    (folder / "run.toml").write_text(text)
    run = read_run(folder / "run.toml")
    assert isinstance(run, JointRun)
    said: list[str] = []
    joint, estimate, notes = joint_pipeline.read_frames(run, folder / "run.toml", said.append)
    assert estimate is not None and estimate.at_maximum and estimate.n_evaluations <= 6
    assert said == notes and [note.partition(":")[0] for note in notes] == [*"aaabbbccc"]
    again = bf.find_map(joint)
    sd = np.sqrt(np.diag(again.covariance))
    assert np.abs((again.params - estimate.params) / sd).max() < 2e-3


@pytest.mark.parametrize("share", [0.5, 0.3])
def test_a_frame_most_of_whose_sources_were_rejected_does_not_fit(
    folder: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    """The search for the maximum of all frames rejects nothing itself."""
    text = RUN.replace("[catalogue]", "[frame]\nreject_outliers = true\n[catalogue]", 1)
    (folder / "run.toml").write_text(text)
    shares = iter([0.0, share, 0.1])
    monkeypatch.setattr(pipeline, "share_lost", lambda *_: next(shares))
    run = read_run(folder / "run.toml")
    assert isinstance(run, JointRun)
    joint, estimate, _ = joint_pipeline.read_frames(run, folder / "run.toml", None)
    assert estimate is not None and estimate.at_maximum
    assert estimate.fits_data == (share < 0.4)
    assert ("; b: but over 40 % of the sources" in estimate.message) == (share > 0.4)
    assert estimate.message.count("over 40 %") == (share > 0.4)
    diagnostics = bf.diagnose(bf.laplace(joint, estimate, seed=1))
    assert diagnostics.trustworthy == (share < 0.4)
    assert ("b: but over 40 %" in diagnostics.message) == (share > 0.4)


@pytest.mark.long
def test_a_psf_between_nodes_is_refused_before_any_is_measured(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "read_doubted", lambda *_, **__: pytest.fail("a frame was read"))
    psf = 'kind = "measured"\nsigma = 2.0\nnodes = 3'
    (folder / "nodes.toml").write_text(RUN.replace("sigma = 2.0", psf))
    found = invoke(folder, "fit", "nodes.toml", "--map-only")
    assert_refused(found, "nodes.toml: psf: got one that varies between 3 x 3 nodes", "a degree")


def test_psfs_are_measured_on_each_frame_or_shared_from_a_file(folder: Path) -> None:
    def read(psf: str) -> bf.JointPosterior:
        text = RUN.replace("sigma = 2.0", psf)
        text = text.replace("[sampling]", '[nuisances]\nflux = "free"\noffset = true\n[sampling]')
        (folder / "run.toml").write_text(text)
        run = read_run(folder / "run.toml")
        assert isinstance(run, JointRun)
        joint, estimate, _ = joint_pipeline.read_frames(run, folder / "run.toml", None)
        assert joint.psf_errors is not None and estimate is not None and estimate.at_maximum
        names = [path.name for path in files_beside(folder / "run.h5", joint.frames)]
        assert {f"run.{name}.psf.fits" for name in "abc"} <= set(names)
        return joint

    own = read('kind = "measured"\nsigma = 2.2')
    assert len({id(frame.model.psf) for frame in own.frames.values()}) == 3
    own.frames["a"].model.psf.write(folder / "a.psf.fits")
    common = read('kind = "file"\npath = "a.psf.fits"')  # its errors are common to all frames
    assert len({id(frame.model.psf) for frame in common.frames.values()}) == 1

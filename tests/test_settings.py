"""The run file: defaults, every refusal in one line, and where files are looked up."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel, ValidationError

from bayesfred import settings
from bayesfred.errors import InputError
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.io.paths import resolve, within
from bayesfred.io.serialize import kinds, serializable
from bayesfred.settings.joint import DriftSettings, JointSettings
from bayesfred.settings.run import PriorSettings, RunSettings, read_settings
from bayesfred.settings.sections import model_of

EXAMPLE = Path(settings.__file__).with_name("example.toml").read_text(encoding="utf-8")

SECTIONS = {
    "frame": 'path = "frame.fits"',
    "catalogue": 'path = "stars.csv"',
    "psf": "sigma = 2",
    "distortion": 'terms = "mirrored"',
}


def read(folder: Path, text: str = "", **sections: str) -> RunSettings:
    """Read a run file of the sections every one needs, or those given, and more text."""
    body = "\n".join(f"[{name}]\n{keys}" for name, keys in {**SECTIONS, **sections}.items())
    path = folder / "run.toml"
    path.write_text(f"{body}\n{text}\n", encoding="utf-8")
    return read_settings(path)


def message(folder: Path, text: str = "", **sections: str) -> str:
    """Return what follows the file's name in the one line that refuses a run file."""
    with pytest.raises(InputError) as caught:
        read(folder, text, **sections)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(f"{folder / 'run.toml'}: ")
    return line.removeprefix(f"{folder / 'run.toml'}: ")


def is_section(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def test_defaults(tmp_path: Path) -> None:
    settings = read(tmp_path)
    assert settings.model_dump(exclude_none=True) == {
        "frame": {"path": "frame.fits", "reject_outliers": False},
        "catalogue": {"path": "stars.csv", "x": "x", "y": "y", "flux": "flux"},
        "detector": {"pixel": "impulse", "binning": 1},
        "psf": {"kind": "gaussian", "sigma": 2.0},
        "distortion": {"terms": "mirrored"},
        "model": {"conserve_flux": True, "tolerance": 1e-8},
        "noise": {"kind": "poisson", "read_noise": 0.0},
        "nuisances": {
            "flux": "fixed",
            "offset": False,
            "psf_sigma": False,
            "background_order": 0,
            "position_scatter": False,
            "flux_shape": 2.0,
            "model_error": False,
        },
        "prior": {},
        "sampling": {"seed": 1, "ensembles": 4, "walkers": 32, "target_ess": 1000},
        "output": {},
        "sky": {},
    }


def test_example(tmp_path: Path) -> None:
    assert max(map(len, EXAMPLE.splitlines())) < 90
    path = tmp_path / "run.toml"
    path.write_text(EXAMPLE, encoding="utf-8")
    settings = read_settings(path)
    assert settings.simulation is not None
    assert settings.simulation.grid is not None
    assert settings.simulation.shape == (505, 505)
    assert settings.simulation.grid.model_dump() == {"side": 9, "spacing": 50.0, "flux": 1e5}
    assert settings.simulation.theta["g_vy2"] == -1e-6
    assert len(settings.simulation.theta) == 8
    # What it shows as usual is the default.
    for name in ("detector", "model", "noise", "nuisances", "sampling", "output"):
        assert getattr(settings, name) == RunSettings.model_fields[name].default


def test_example_names_every_key(tmp_path: Path) -> None:
    lines = EXAMPLE.splitlines()
    text = "\n".join(re.sub(r"^# (?=\w+ = |\[)", "", line) for line in lines)
    table = tomllib.loads(text)
    (entry,), joint = table.pop("frames"), table.pop("joint")
    assert set(joint) == set(JointSettings.model_fields)
    assert set(joint["drift"]) == set(DriftSettings.model_fields)
    assert set(entry) == {"name", "time", "path", "catalogue"}  # the others are named above
    assert set(table) == set(RunSettings.model_fields)
    for name, field in RunSettings.model_fields.items():
        if name in ("psf", "noise"):  # the keys of every kind
            package = [k for k, c in kinds(name).items() if c.__module__.startswith("bayesfred.")]
            models = [model_of(name, {"kind": kind}) for kind in package]
            keys = {key for model in models for key in model.model_fields}
        elif name in ("detector", "nuisances"):
            keys = set(model_of(name, {}).model_fields)
        else:
            arms = (field.annotation, *get_args(field.annotation))
            keys = set(next(kind for kind in arms if is_section(kind)).model_fields)
        assert name == "prior" or set(table[name]) == keys
    # All of them at once, but for the keys that exclude others, are a run file.
    path = tmp_path / "run.toml"
    text = text[: text.index("[joint]")]
    path.write_text(
        re.sub(
            r"(?m)^((degree|[fg]_terms|fwhm|beta|oversampling|nodes|variance|rows|columns|pitch|layout"
            r"|marks) = |path = \"psf|\[catalogue.grid)",
            "# ",
            text,
        )
    )
    settings = read_settings(path)
    assert settings.prior["f_ux"].keywords == {"loc": 0.0, "scale": 1e-5}
    assert settings.catalogue.zero_point == 25.0


def test_everything_is_kept_as_json(tmp_path: Path) -> None:
    settings = read(
        tmp_path,
        '[prior.f_ux]\ndistribution = "norm"\nloc = 0\nscale = 1e-6\n'
        "[simulation]\nshape = [10, 20]\ntheta = {f_ux = 1e-4}\nbackground = 0\n",
        distortion="f_terms = [[1, 0, 1, 0]]\ng_terms = [[0, 1, 0, 1], [0, 1, 2, 0]]",
    )
    assert settings.distortion.g_terms == ((0, 1, 0, 1), (0, 1, 2, 0))
    assert settings.prior["f_ux"].distribution == "norm"
    assert settings.prior["f_ux"].keywords == {"loc": 0.0, "scale": 1e-6}
    again = RunSettings.model_validate_json(settings.model_dump_json())
    assert again == settings
    assert again.model_dump_json() == settings.model_dump_json()


@serializable("psf.outside")
@dataclass(frozen=True)
class OutsidePSF:
    """A family that the package knows nothing of."""

    width: float
    turned: bool = False

    def __post_init__(self) -> None:
        if not self.width > 0:
            raise InputError(f"psf: width: got {self.width}, expected more")


def test_a_family_from_outside_is_named_by_its_kind(tmp_path: Path) -> None:
    settings = read(tmp_path, psf='kind = "outside"\nwidth = 3')
    assert settings.psf.make() == OutsidePSF(3.0)
    again = RunSettings.model_validate_json(settings.model_dump_json())
    assert again == settings and again.psf.make() == OutsidePSF(3.0)
    for keys, expected in (
        ("", "psf.width: missing"),
        ("width = 0", "psf.width: got 0.0, expected more"),
        ("width = 1\nturned = 1", "psf.turned: got 1, expected a valid boolean"),
        ("width = 1\nsigma = 1", "psf.sigma: unknown key with kind = 'outside', expected one of"),
    ):
        assert expected in message(tmp_path, psf=f'kind = "outside"\n{keys}')


def test_bases_by_name(tmp_path: Path) -> None:
    for terms, n_terms in (("mirrored", 12), ("pinhole", 8), ("radial_tangential", 5)):
        d = read(tmp_path, distortion=f'terms = "{terms}"').distortion
        assert d.make(100.0).n_terms == n_terms
        assert "expected it with terms = 'polynomial'" in message(
            tmp_path, distortion=f'terms = "{terms}"\ndegree = 2'
        )
    for terms, n_terms in (("polynomial", 18), ("full_polynomial", 46), ("zernike", 18)):
        d = read(tmp_path, distortion=f'terms = "{terms}"\ndegree = 3').distortion
        assert d.make(100.0).n_terms == n_terms
        assert "distortion: got no degree" in message(tmp_path, distortion=f'terms = "{terms}"')
    assert d.make(100.0) == PolynomialDistortion.zernike(3, radius=100.0)


def test_settings_are_frozen(tmp_path: Path) -> None:
    settings = read(tmp_path)
    with pytest.raises(ValidationError, match="frozen"):
        settings.psf.sigma = 3.0
    with pytest.raises(ValidationError, match="frozen"):
        PriorSettings(distribution="norm").distribution = "cauchy"


@pytest.mark.parametrize(
    ("section", "keys", "expected"),
    [
        ("frame", "gain = 2", "frame.path: missing, expected a value"),
        ("frame", "path = 3", "frame.path: got 3, expected a valid string"),
        ("frame", 'path = ""', "frame.path: got '', expected one with at least 1 character"),
        ("frame", 'path = "a"\ngain = 0', "frame.gain: got 0, expected a number greater than 0"),
        ("frame", 'path = "a"\ngain = "2"', "frame.gain: got '2', expected a valid number"),
        ("frame", 'path = "a"\ngain = true', "frame.gain: got True, expected a valid number"),
        (
            "frame",
            'path = "a"\npedestal = inf',
            "frame.pedestal: got inf, expected a finite number",
        ),
        (
            "frame",
            'path = "a"\nsaturation = nan',
            "frame.saturation: got nan, expected a finite number",
        ),
        (
            "frame",
            'path = "a"\npedestel = 1',
            "frame.pedestel: unknown key, did you mean 'pedestal'?",
        ),
        (
            "psf",
            "sigma = 2\nqqq = 1",
            "psf.qqq: unknown key with kind = 'gaussian', expected one of kind, sigma",
        ),
        ("psf", "sigma = -1.5", "psf.sigma: got -1.5, expected a positive width in pixels"),
        ("psf", "", "psf.sigma: missing, expected a value"),
        (
            "psf",
            "fwhm = 2",
            "psf.sigma: missing, expected a value; psf.fwhm: unknown key with kind = "
            "'gaussian', expected one of kind, sigma",
        ),
        (
            "psf",
            'kind = "moffat"\nfwhm = 2',
            "psf.beta: missing, expected a value",
        ),
        (
            "psf",
            'kind = "moffat"\nfwhm = 2\nbeta = 1',
            "psf.beta: got 1.0, expected 1 < beta <= 100: use a Gaussian in place of larger ones",
        ),
        (
            "psf",
            'kind = "sampled"\nsigma = 2',
            "psf.path: missing, expected a value; psf.oversampling: missing, expected a value; "
            "psf.sigma: unknown key with kind = 'sampled', expected one of kind, path, "
            "oversampling",
        ),
        (
            "psf",
            'kind = "sampled"\npath = "p.npy"\noversampling = 0.5',
            "psf.oversampling: got 0.5, expected samples per pixel, 1 to 1001",
        ),
        (
            "psf",
            'kind = "airy"',
            "psf.kind: got 'airy', expected '",
        ),
        ("psf", "kind = 3\nsigma = 1", "psf.kind: got 3, expected '"),
        ("psf", 'kind = "gaussian"\nsigma = 1e16', "psf.sigma: got 1e+16, expected a number less"),
        ("psf", 'sigma = "2"', "psf.sigma: got '2', expected a valid number"),
        (
            "psf",
            "sigmma = 2",
            "psf.sigmma: unknown key with kind = 'gaussian', did you mean 'sigma'?",
        ),
        (
            "catalogue",
            'path = "a"\nmagnitude = "m"',
            "catalogue: got magnitude alone, expected magnitude and zero_point together",
        ),
        ("catalogue", 'path = "a"\nzero_point = 25', "catalogue: got zero_point alone"),
        (
            "detector",
            'pixel = "square"',
            "detector.pixel: got 'square', expected one of 'impulse', 'box'",
        ),
        (
            "detector",
            "binning = 0",
            "detector.binning: got 0, expected an integer of 1 to 1000",
        ),
        ("detector", "binning = 1.5", "detector.binning: got 1.5, expected a valid integer"),
        (
            "distortion",
            "",
            "distortion: got no terms, expected either terms, or both f_terms and g_terms",
        ),
        ("distortion", "f_terms = [[1, 0, 0, 0]]", "distortion: got f_terms, expected either"),
        (
            "distortion",
            'terms = "paper"\nf_terms = [[1, 0, 0, 0]]\ng_terms = []',
            "distortion: got terms and f_terms and g_terms, expected either",
        ),
        ("distortion", "f_terms = []\ng_terms = []", "distortion: got f_terms and g_terms empty"),
        ("distortion", 'terms = "full_polynomial"', "distortion: got no degree"),
        (
            "distortion",
            'terms = "full_polynomial"\ndegree = 1',
            "distortion.degree: got 1, expected an integer of at least 2",
        ),
        ("distortion", 'terms = "paper"\ndegree = 3', "distortion: got degree 3"),
        (
            "distortion",
            'terms = "papers"',
            "distortion.terms: got 'papers', expected 'mirrored', 'paper'",
        ),
        (
            "distortion",
            "f_terms = [[1, 0, 0]]\ng_terms = []",
            "distortion.f_terms.0.3: missing, expected a value",
        ),
        (
            "distortion",
            "f_terms = [[1, 0, 0, -1]]\ng_terms = []",
            "distortion.f_terms.0.3: got -1, expected a number greater than or equal to 0",
        ),
        (
            "distortion",
            "f_terms = [[1, 0, 0, 0, 0]]\ng_terms = []",
            "distortion.f_terms.0: got [1, 0, 0, 0, 0], expected one with at most 4 items",
        ),
        ("model", "tolerance = 1.0", "model.tolerance: got 1.0, expected a number less than 1"),
        (
            "model",
            "tolerance = -1e-9",
            "model.tolerance: got -1e-09, expected a number greater than or",
        ),
        ("model", "conserve_flux = 1", "model.conserve_flux: got 1, expected a valid boolean"),
        ("noise", 'kind = "gauss"', "noise.kind: got 'gauss', expected 'background'"),
        (
            "noise",
            "read_noise = -1",
            "noise.read_noise: got -1.0, expected a standard deviation in counts, from 0.01",
        ),
        (
            "noise",
            'kind = "background"\nread_noise = 2.0',
            "noise.read_noise: unknown key with kind = 'background', expected one of kind",
        ),
        (
            "nuisances",
            'flux = "none"',
            "nuisances.flux: got 'none', expected 'fixed', 'scale' or 'free'",
        ),
        (
            "nuisances",
            "background_order = 5",
            "nuisances.background_order: got 5, expected an integer from 0 to 4",
        ),
        (
            "nuisances",
            "footprint = 0.0",
            "nuisances.footprint: got 0.0, expected a radius in pixels > 0",
        ),
        ("nuisances", "position_scatter = true", "nuisances.position_scatter: got it with fixed"),
        ("nuisances", "ofset = true", "nuisances.ofset: unknown key, did you mean 'offset'?"),
        ("nuisances", 'offset = "yes"', "nuisances.offset: got 'yes', expected a valid boolean"),
        ("prior", "f_ux = 3", "prior.f_ux: got 3, expected a table"),
        ("prior.f_ux", "scale = 1", "prior.f_ux.distribution: missing, expected a value"),
        (
            "prior.f_ux",
            'distribution = "norm"\nscale = "1"',
            "prior.f_ux.scale: got '1', expected a valid number",
        ),
        (
            "prior.f_ux",
            'distribution = "norm"\nscale = inf',
            "prior.f_ux.scale: got inf, expected a finite number",
        ),
        (
            "sampling",
            "ensembles = 1",
            "sampling.ensembles: got 1, expected a number greater than or equal to 2",
        ),
        (
            "sampling",
            "walkers = 2",
            "sampling.walkers: got 2, expected a number greater than or equal to 4",
        ),
        ("sampling", "walkers = 7", "sampling.walkers: got 7, expected a multiple of 2"),
        ("sampling", "target_ess = 0", "sampling.target_ess: got 0"),
        ("sampling", "steps = 0", "sampling.steps: got 0"),
        ("sampling", "seed = -1", "sampling.seed: got -1"),
        ("output", 'file = "a.h5"', "output.file: unknown key"),
        ("simulation", "theta = {}\nbackground = 1", "simulation.shape: missing, expected a value"),
        ("simulation", "shape = [0, 5]\ntheta = {}\nbackground = 1", "simulation.shape.0: got 0"),
        (
            "simulation",
            "shape = [5, 5, 5]\ntheta = {}\nbackground = 1",
            "simulation.shape: got [5, 5, 5]",
        ),
        (
            "simulation",
            "shape = [5, 5]\ntheta = {f_ux = nan}\nbackground = 1",
            "simulation.theta.f_ux: got nan",
        ),
        (
            "simulation",
            "shape = [5, 5]\ntheta = {}\nbackground = -1",
            "simulation.background: got -1",
        ),
        (
            "simulation",
            "shape = [5, 5]\ntheta = {}\nbackground = 1\ngrid = {side = 2, spacing = 5, flu = 1}",
            "simulation.grid.flux: missing, expected a value; simulation.grid.flu: unknown key, "
            "did you mean 'flux'?",
        ),
        (
            "frame",
            "path = 2000-01-01",
            "frame.path: got {'2000-01-01': 'date'}, expected a valid string",
        ),
        (
            "psf",
            "sigma = 1e300",
            "psf.sigma: got 1e+300, expected a number less than or equal to 1000000000000000",
        ),
        ("psf", f"sigma = 1{'0' * 400}", "psf.sigma: got "),
        (
            "detector",
            "binning = 1001",
            "detector.binning: got 1001, expected an integer of 1 to 1000",
        ),
        (
            "distortion",
            'terms = "full_polynomial"\ndegree = 11',
            "distortion.degree: got 11, expected a number less than or",
        ),
        (
            "distortion",
            "f_terms = [[1, 0, 11, 0]]\ng_terms = []",
            "distortion.f_terms.0.2: got 11, expected a number less",
        ),
        (
            "sampling",
            "walkers = 10002",
            "sampling.walkers: got 10002, expected a number less than or equal to 10000",
        ),
        (
            "sampling",
            "ensembles = 1001",
            "sampling.ensembles: got 1001, expected a number less than or equal to 1000",
        ),
        (
            "sampling",
            f"seed = {2**63}",
            f"sampling.seed: got {2**63}, expected a number less than {2**63}",
        ),
        ("output", 'path = "run.png"', "output.path: got 'run.png', expected"),
        ("simulate", "seed = 1", "simulate: unknown key, did you mean 'simulation'?"),
        ("'a\\nb'", "seed = 1", "a\\nb: unknown key, expected one of frame, catalogue"),
    ],
)
def test_refusals(tmp_path: Path, section: str, keys: str, expected: str) -> None:
    assert expected in message(tmp_path, **{section: keys})


def test_a_missing_section_and_several_mistakes(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text(
        'frame = 3\n[catalogue]\npath = "a"\n[psf]\nsigma = 0\n[distortion]\nterms = '
        '"paper"\n["x\\ny"]\n'
    )
    with pytest.raises(InputError) as caught:
        read_settings(path)
    assert str(caught.value).startswith(
        f"{path}: frame: got 3, expected a table; psf.sigma: got 0.0, expected a positive width in "
        "pixels; x y: unknown key, expected one of frame"
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("key", "not TOML (Expected '=' after a key in a key/value pair (at line "),
        ("[psf]", "not TOML (Cannot declare ('psf',) twice (at line "),
        (f"deep = {'[' * 300}{']' * 300}", "nested too deeply"),
        (f"deep = {'[' * 20000}{']' * 20000}", "nested too deeply"),
        (f"{'a.' * 2000}b = 1", "nested too deeply"),
        (f"big = {'1' * 5000}", "not TOML"),
    ],
)
def test_text_that_is_not_a_run_file(tmp_path: Path, text: str, expected: str) -> None:
    assert expected in message(tmp_path, text)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no\.toml: no such file, expected one to read"):
        read_settings(tmp_path / "no.toml")
    with pytest.raises(InputError, match="not a file, expected one to read"):
        read_settings(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b"# \xe9\n")
    with pytest.raises(InputError, match=r"latin\.toml: not TOML \('utf-8' codec"):
        read_settings(tmp_path / "latin.toml")


def test_byte_order_mark_and_line_ends(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_bytes(b"\xef\xbb\xbf" + EXAMPLE.replace("\n", "\r\n").encode())
    assert read_settings(path).psf.sigma == 10.0


def test_resolve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs, data = tmp_path / "commands", tmp_path / "data"
    runs.mkdir()
    data.mkdir()
    run_file = runs / "run.toml"
    (runs / "both.fits").touch()
    (data / "both.fits").touch()
    (data / "data.fits").touch()
    monkeypatch.delenv("BAYESFRED_DATA", raising=False)
    assert resolve("both.fits", run_file) == runs / "both.fits"
    assert resolve("data.fits", run_file) == runs / "data.fits"
    monkeypatch.setenv("BAYESFRED_DATA", str(data))
    assert resolve("both.fits", run_file) == runs / "both.fits"
    assert resolve("data.fits", run_file, must_exist=True) == data / "data.fits"
    assert resolve("none.fits", run_file) == runs / "none.fits"
    assert resolve(data / "data.fits", run_file) == data / "data.fits"
    assert resolve(str(data / "none.fits"), run_file) == data / "none.fits"


def test_within(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "commands"
    (folder / "sub").mkdir(parents=True)
    (folder / "inner").symlink_to("sub")
    (folder / "outer").symlink_to(tmp_path)
    (folder / "up.h5").symlink_to(tmp_path / "a.h5")
    (folder / "circle").symlink_to("circle")
    for path in (
        "a.h5",
        "sub/a.h5",
        "sub/../a.h5",
        "inner/a.h5",
        f"{folder}/a.h5",
        "outer/commands/a.h5",
    ):
        assert within(folder, path, "where") == folder / path
    for path in (
        "../a.h5",
        "sub/../../a.h5",
        "outer/a.h5",
        "up.h5",
        "circle/a.h5",
        f"{tmp_path}/a.h5",
        "/a.h5",
        "a\0.h5",
    ):
        with pytest.raises(
            InputError,
            match=r"^where: got .*, which leads out of .*commands, expected a path that stays ins",
        ):
            within(folder, path, "where")
    monkeypatch.chdir(folder)
    assert within(".", "a.h5", "where") == Path("a.h5")


def test_resolve_says_where_it_looked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_file = tmp_path / "run.toml"
    monkeypatch.setenv("BAYESFRED_DATA", str(tmp_path / "data"))
    with pytest.raises(InputError) as caught:
        resolve("no.fits", run_file, must_exist=True)
    assert str(caught.value) == (
        f"{run_file}: got 'no.fits', expected a file at {tmp_path / 'no.fits'} or "
        f"{tmp_path / 'data' / 'no.fits'}; "
        "check the path or set BAYESFRED_DATA to the folder that holds it"
    )
    with pytest.raises(InputError, match=r"check the path$"):
        resolve(tmp_path / "no.fits", run_file, must_exist=True)

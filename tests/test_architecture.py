"""The package's shape as far as linters cannot hold it; import-linter and ruff hold the rest.

Every rule is a function of source text: each is also shown to fail on a text that breaks it.
"""

import ast
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from numpydoc.validate import validate

import bayesfred

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "bayesfred"
MODULES = {path: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}
PUBLIC = [name for name in bayesfred.__all__ if name not in ("commands", "show")]


def long_modules(sources: dict[Path, str]) -> list[str]:
    return [path.name for path, source in sources.items() if len(source.splitlines()) > 400]


def test_modules_are_short() -> None:
    assert len(MODULES) > 50
    assert long_modules(MODULES) == []
    assert long_modules({Path("a.py"): "x = 1\n" * 401, Path("b.py"): "x = 1\n" * 400}) == ["a.py"]


def test_stub_names_what_it_imports() -> None:
    """The stub is what a type checker and `lazy_loader` read: its __all__ and its imports agree."""
    tree = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    names = [alias.asname or alias.name for node in imports for alias in node.names]
    stated = [ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign)]
    assert stated == [sorted(names)] == [sorted(bayesfred.__all__)]
    assert len(set(names)) == len(names) > 15
    assert set(names) <= set(dir(bayesfred))


# --- documentation --------------------------------------------------------------------------------

# Parameters that are missing, unknown or in another order, no Returns, no docstring.
WANTED = {"PR01", "PR02", "PR03", "RT01", "GL08"}


def definition(name: str) -> ast.FunctionDef | ast.ClassDef:
    """The source of a public name."""
    module = sys.modules[getattr(bayesfred, name).__module__]
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    nodes = [n for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    return next(node for node in nodes if node.name == name)


def undocumented(name: str, node: ast.FunctionDef | ast.ClassDef) -> list[str]:
    """What numpydoc misses, and what it does not look for: Raises, and fields as Attributes."""
    docstring = ast.get_docstring(node) or ""
    errors = [code for code, _ in validate(f"bayesfred.{name}")["errors"] if code in WANTED]
    if isinstance(node, ast.ClassDef):
        fields = [child for child in node.body if isinstance(child, ast.AnnAssign)]
        names = [ast.unparse(f.target) for f in fields if "ClassVar" not in ast.unparse(f)]
        told = re.findall(r"^(\w+(?:, \w+)*) : ", docstring, flags=re.MULTILINE)
        missing = set(names) - {word for line in told for word in line.split(", ")}
        if "Attributes\n---" in docstring:  # the fields of a result, which numpydoc takes for none
            errors = [code for code in errors if code != "PR01"]
        errors += [f"field {field}" for field in sorted(missing)]
        bodies = [c for c in node.body if getattr(c, "name", "") in ("__init__", "__post_init__")]
    else:
        bodies = [node]
    raised = [r for b in bodies for r in ast.walk(b) if isinstance(r, ast.Raise) and r.exc]
    return errors + (["Raises"] if raised and "Raises\n---" not in docstring else [])


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_are_documented(name: str) -> None:
    assert undocumented(name, definition(name)) == []


def test_lack_of_documentation_is_seen() -> None:
    node = definition("find_map")
    node.body[0] = ast.parse('"""Nothing."""').body[0]
    node.body.append(ast.parse("raise ValueError").body[0])
    assert undocumented("find_map", node) == ["Raises"]
    record = definition("MapEstimate")
    record.body.append(ast.parse("new: int").body[0])
    assert undocumented("MapEstimate", record) == ["field new"]


# --- weight ---------------------------------------------------------------------------------------

HEAVY = (
    "arviz_base", "arviz_stats", "astropy", "emcee", "h5py", "matplotlib", "numba", "pydantic",
    "scipy",
)  # fmt: skip


def loaded(code: str) -> set[str]:
    """The heavy packages that a fresh interpreter has loaded after running some code."""
    report = f"\nimport sys\nprint('loaded', *(n for n in {HEAVY} if n in sys.modules))"
    env = {name: value for name, value in os.environ.items() if name != "EAGER_IMPORT"}
    command = [sys.executable, "-c", code + report]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split()[1:])


def test_heavy_packages_are_loaded_when_they_are_needed() -> None:
    assert loaded("import bayesfred\nbayesfred.InputError, dir(bayesfred)") == set()
    for words in (["--help"], ["--version"], ["fit", "--help"], ["fit", "missing.toml"]):
        said = (
            f"from bayesfred.cli import app\ntry:\n    app({words})\nexcept SystemExit:\n    pass"
        )
        assert loaded(said) <= {"pydantic"}  # which typer uses to read arguments
    assert "scipy" in loaded("import bayesfred\nbayesfred.Detector")


@pytest.mark.parametrize("script", sorted(ROOT.glob("examples/*.py")), ids=lambda path: path.stem)
def test_examples_find_what_they_import(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(script.parent))
    runpy.run_path(str(script), run_name="imported")


def absent(source: str) -> set[str]:
    """Names that a text takes of the package as `bf`, and that it does not have."""
    return set(re.findall(r"\bbf\.([A-Za-z]\w*)", source)) - set(bayesfred.__all__)


def test_benchmarks_and_examples_take_names_that_there_are() -> None:
    scripts = [
        path for folder in ("benchmarks", "examples") for path in ROOT.glob(f"{folder}/*.py")
    ]
    assert len(scripts) > 15
    used = {path.name: absent(path.read_text(encoding="utf-8")) for path in scripts}
    assert {name: names for name, names in used.items() if names} == {}
    assert absent("def image(psf: bf.PSF) -> bf.Chain: ...") == {"PSF"}


# --- places of one machine ------------------------------------------------------------------------

MACHINE_PATH = re.compile(r"(?<![\w.<])/(?:work|tmp|home|root|Users|mnt)\b|\.\./shared|\b[A-Z]:\\")
TEXTS = [
    *(p for folder in ("bayesfred", "examples", "chains") for p in (ROOT / folder).rglob("*")),
    *(p for p in ROOT.iterdir() if p.suffix in (".md", ".toml")),
]


def test_no_paths_of_one_machine() -> None:
    """Kept runs, which git ignores, are no text of the project."""
    kinds = (".py", ".pyi", ".toml", ".md")
    texts = [path for path in TEXTS if path.suffix in kinds or path.suffix == ".html"]
    assert ROOT / "README.md" in texts
    found = {p.name: MACHINE_PATH.findall(p.read_text(encoding="utf-8")) for p in texts}
    assert {name: places for name, places in found.items() if places} == {}
    for text in ("in /work", "open('/tmp/x')", "(../shared/data)", "/home/me/x", r"C:\data"):
        assert len(MACHINE_PATH.findall(text)) == 1
    assert not MACHINE_PATH.findall(
        "e-/adu, https://example.org/home/x, tests/work, 1/tmp, </root>"
    )

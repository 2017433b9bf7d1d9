"""The shape of the package, read from its source: who imports whom, what stays in which room, what is documented.

Every rule is a function of source text, so that each is also shown to fail on a text that breaks
it.
"""

import ast
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

import bayesfred

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "bayesfred"

Definition = ast.FunctionDef | ast.ClassDef


def module_name(path: Path) -> str:
    """Dotted name of a file of the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {
    module_name(path): path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))
}
PACKAGES = {module_name(path) for path in PACKAGE.rglob("__init__.py")}


def test_there_is_something_to_read() -> None:
    assert {
        "bayesfred",
        "bayesfred.errors",
        "bayesfred.imaging.kernels.geometry",
        "bayesfred.cli",
    } <= set(SOURCES)
    assert {"bayesfred", "bayesfred.imaging", "bayesfred.imaging.kernels"} <= PACKAGES


# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Import:
    """One imported module: its absolute name, the line, whether a function does it."""

    module: str
    line: int
    in_function: bool


def imports(source: str, module: str) -> list[Import]:
    """All imports of a module; `from package import name` counts as package.name where that is a module."""
    found: list[Import] = []

    def visit(node: ast.AST, in_function: bool) -> None:
        for child in ast.iter_child_nodes(node):
            for name in imported(child, module):
                found.append(Import(name, child.lineno, in_function))  # type: ignore[attr-defined]
            visit(
                child,
                in_function
                or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda),
            )

    visit(ast.parse(source), False)
    return found


def imported(node: ast.AST, module: str) -> Iterator[str]:
    """Absolute names of the modules that a statement imports."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    if isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
            here = module.split(".") if module in PACKAGES else module.split(".")[:-1]
            base = ".".join(
                [*here[: len(here) - node.level + 1], *([node.module] if node.module else [])]
            )
        for alias in node.names:
            full = f"{base}.{alias.name}"
            yield full if full in SOURCES else base


def is_within(module: str, places: Iterable[str]) -> bool:
    """Whether a module is one of the places or below one."""
    return any(module == place or module.startswith(f"{place}.") for place in places)


def within_package(names: Iterable[str]) -> list[str]:
    return [f"bayesfred.{name}" for name in names]


# What each room may import from the package besides itself; the order is the direction of the
# imports.
BELOW = {
    "errors": (),
    "io": ("errors",),
    "imaging": ("errors",),
    "settings": ("errors",),
    "model": ("errors", "imaging"),
    "optimize": ("errors", "imaging", "model"),
    "sampling": ("errors", "io", "imaging", "model", "optimize"),
    "analysis": ("errors", "io", "imaging", "model", "optimize", "sampling"),
    "reporting": ("errors", "io", "imaging", "model", "optimize", "sampling", "analysis"),
    "build": ("errors", "io", "imaging", "model", "settings"),
}
MAY_IMPORT = {**BELOW, "commands": tuple(BELOW)}


def wrong_way(source: str, module: str) -> list[str]:
    """Imports from a room that this one may not know. The command line knows the public names, the runs and the errors."""
    names = {i.module for i in imports(source, module) if is_within(i.module, ["bayesfred"])}
    if module == "bayesfred":
        return sorted(names)
    if module == "bayesfred.cli":
        return sorted(names - {"bayesfred", "bayesfred.errors", "bayesfred.commands"})
    room = module.split(".")[1]
    return sorted(
        name for name in names if not is_within(name, within_package((room, *MAY_IMPORT[room])))
    )


@pytest.mark.parametrize("module", SOURCES)
def test_imports_run_one_way(module: str) -> None:
    assert wrong_way(SOURCES[module], module) == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("bayesfred.imaging.psf", "from bayesfred.model.noise import PoissonNoise"),
        ("bayesfred.imaging.psf", "from ..model import noise"),
        ("bayesfred.model.noise", "import bayesfred.analysis.diagnostics"),
        ("bayesfred.analysis.diagnostics", "from bayesfred.reporting import plots"),
        ("bayesfred.reporting.plots", "from bayesfred.commands import Result"),
        ("bayesfred.commands", "def f():\n    from bayesfred import cli"),
        ("bayesfred.io.files", "from bayesfred import settings"),
        ("bayesfred.settings", "from bayesfred.imaging.detector import PIXELS"),
        ("bayesfred.errors", "from bayesfred.io import files"),
        ("bayesfred.cli", "from bayesfred.sampling.sampler import sample"),
        ("bayesfred.imaging.psf", "import bayesfred as bf"),
        ("bayesfred", "from bayesfred.errors import InputError"),
    ],
)
def test_wrong_way_is_seen(module: str, source: str) -> None:
    assert len(wrong_way(source, module)) == 1


def test_every_room_has_its_rule() -> None:
    rooms = {module.split(".")[1] for module in SOURCES if "." in module}
    assert rooms == {*MAY_IMPORT, "cli"}


def cycle(graph: Mapping[str, Iterable[str]]) -> list[str]:
    """Find a way through the graph that comes back to where it began; empty if there is none."""
    done: set[str] = set()

    def follow(node: str, path: list[str]) -> list[str]:
        if node in path:
            return [*path[path.index(node) :], node]
        if node in done:
            return []
        for successor in graph.get(node, ()):
            if found := follow(successor, [*path, node]):
                return found
        done.add(node)
        return []

    return next((found for node in graph if (found := follow(node, []))), [])


def import_graph(sources: Mapping[str, str]) -> dict[str, set[str]]:
    return {
        name: {i.module for i in imports(source, name)} & set(sources)
        for name, source in sources.items()
    }


def test_no_import_cycles() -> None:
    graph = import_graph(SOURCES)
    assert graph["bayesfred.sampling.sampler"] >= {
        "bayesfred.sampling.ensembles",
        "bayesfred.errors",
    }
    assert cycle(graph) == []


def test_cycle_is_seen() -> None:
    sources = {
        "bayesfred.commands": "from bayesfred.model import moves, noise",
        "bayesfred.sampling.moves": "from bayesfred.sampling.sampler import sample",
        "bayesfred.sampling.sampler": "from . import moves",
        "bayesfred.model.noise": "import math",
    }
    assert set(cycle(import_graph(sources))) == {
        "bayesfred.sampling.moves",
        "bayesfred.sampling.sampler",
    }


def hidden_imports(source: str, module: str) -> list[int]:
    """Lines where a function imports from the package, or a name is imported that only running the code tells."""
    inside = [
        i.line
        for i in imports(source, module)
        if i.in_function and is_within(i.module, ["bayesfred"])
    ]
    return inside + [
        node.lineno
        for node in calls(source)
        if called(node).split(".")[-1] in ("import_module", "__import__")
    ]


def calls(source: str) -> Iterator[ast.Call]:
    return (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))


def called(node: ast.Call) -> str:
    """The dotted name that is called."""
    return ast.unparse(node.func)


@pytest.mark.parametrize("module", SOURCES)
def test_package_imports_stand_at_the_top(module: str) -> None:
    assert hidden_imports(SOURCES[module], module) == []


@pytest.mark.parametrize(
    "source",
    [
        "def f():\n    from bayesfred.errors import InputError",
        "class C:\n    def f(self):\n        from ..imaging import psf",
        "async def f():\n    import bayesfred.commands",
        "import importlib\nimportlib.import_module('bayesfred.commands')",
        "__import__('bayesfred.commands')",
    ],
)
def test_hidden_import_is_seen(source: str) -> None:
    assert len(hidden_imports(source, "bayesfred.model.noise")) == 1


# --------------------------------------------------------------------------------------------------

# The modules, or rooms, in which a package may be imported.
KERNELS = ("imaging.kernels", "model.kernels")
FENCES: dict[str, tuple[str, ...]] = {
    "numba": (*KERNELS, "model.posterior"),  # posterior reads the number of threads: see below
    "llvmlite": ("imaging.kernels.fastmath",),
    "emcee": ("sampling.moves", "sampling.ensembles"),
    "h5py": ("sampling.chainfile", "io"),
    "arviz": ("analysis", "reporting.plots", "sampling.chainfile"),
    "arviz_base": ("analysis", "reporting.plots", "sampling.chainfile"),
    "arviz_stats": ("analysis", "reporting.plots", "sampling.chainfile"),
    "arviz_plots": ("analysis", "reporting.plots", "sampling.chainfile"),
    "matplotlib": ("reporting",),
    "corner": ("reporting",),
    "astropy": ("io",),
    "pydantic": ("settings",),
    "typer": ("cli",),
    "click": ("cli",),
    "jinja2": ("reporting.html",),
    "filelock": ("io.lock",),
    "dask": (),
    "distributed": ("analysis.executor",),
}


def outside_fence(source: str, module: str) -> list[str]:
    """Third-party packages that a module imports and should leave to another."""
    packages = {i.module.split(".")[0] for i in imports(source, module)}
    return sorted(
        p for p in packages if p in FENCES and not is_within(module, within_package(FENCES[p]))
    )


@pytest.mark.parametrize("module", SOURCES)
def test_third_party_packages_stay_in_their_rooms(module: str) -> None:
    assert outside_fence(SOURCES[module], module) == []


@pytest.mark.parametrize("package", FENCES)
def test_package_outside_its_fence_is_seen(package: str) -> None:
    for source in (
        f"import {package}.sub",
        f"from {package} import x",
        f"def f():\n    import {package}",
    ):
        assert outside_fence(source, "bayesfred.imaging.psf") == [package]


def test_rooms_of_the_fences_exist() -> None:
    rooms = {room for places in FENCES.values() for room in within_package(places)}
    assert [
        room for room in rooms if not any(is_within(module, [room]) for module in SOURCES)
    ] == []


def attributes(source: str, name: str) -> set[str]:
    """What a module uses of an imported one: the attributes of its name, and what it imports from it."""
    tree = ast.parse(source)
    used = {
        n.attr
        for n in ast.walk(tree)
        if isinstance(n, ast.Attribute) and ast.unparse(n.value) == name
    }
    return used | {
        a.name
        for n in ast.walk(tree)
        if isinstance(n, ast.ImportFrom) and n.module == name
        for a in n.names
    }


def test_posterior_asks_numba_for_threads_alone() -> None:
    """The one exception to numba's fence: how many threads there are and may be used."""
    assert attributes(SOURCES["bayesfred.model.posterior"], "numba") == {
        "config",
        "get_num_threads",
        "set_num_threads",
    }
    assert attributes("import numba\n@numba.njit\ndef f(x):\n    return x", "numba") == {"njit"}
    assert attributes("from numba import njit", "numba") == {"njit"}


FORBIDDEN_MODULES = {
    "pickle",
    "_pickle",
    "cPickle",
    "cloudpickle",
    "dill",
    "joblib",
    "marshal",
    "shelve",
}


def unsafe(source: str) -> list[int]:
    """Lines that run what a file or a string holds: pickles, eval, exec, arrays of objects."""
    lines = [
        i.line
        for i in imports(source, "bayesfred.x")
        if i.module.split(".")[0] in FORBIDDEN_MODULES
    ]
    for call in calls(source):
        if called(call) in ("eval", "exec", "compile", "builtins.eval", "builtins.exec"):
            lines.append(call.lineno)
        for keyword in call.keywords:
            safe = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
            if keyword.arg == "allow_pickle" and not safe:
                lines.append(call.lineno)
    return lines


@pytest.mark.parametrize("module", SOURCES)
def test_nothing_that_is_read_is_run(module: str) -> None:
    assert unsafe(SOURCES[module]) == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "eval('1')",
        "def f(text):\n    exec(text)",
        "np.load(path, allow_pickle=True)",
        "np.load(path, allow_pickle=flag)",
    ],
)
def test_unsafe_is_seen(source: str) -> None:
    assert len(unsafe(source)) == 1


# --------------------------------------------------------------------------------------------------

SECTION = re.compile(r"^(\w[\w ]*)\n-{3,}$", re.MULTILINE)


def numpydoc_sections(docstring: str) -> dict[str, str]:
    """Text of each section of a docstring, by heading."""
    parts = SECTION.split(docstring)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def described(section: str) -> list[str]:
    """Names that a section describes: `x, y : type` at the margin."""
    heads = [line for line in section.splitlines() if line and not line[0].isspace()]
    return [name.strip().lstrip("*") for head in heads for name in head.split(" : ")[0].split(",")]


def arguments(function: ast.FunctionDef) -> list[str]:
    """Names of a function's parameters, self and cls left out."""
    a = function.args
    every = [
        *a.posonlyargs,
        *a.args,
        *([a.vararg] if a.vararg else []),
        *a.kwonlyargs,
        *([a.kwarg] if a.kwarg else []),
    ]
    return [argument.arg for argument in every if argument.arg not in ("self", "cls")]


def decorators(node: Definition) -> set[str]:
    return {ast.unparse(d).split("(")[0] for d in node.decorator_list}


def methods(node: ast.ClassDef) -> dict[str, ast.FunctionDef]:
    return {child.name: child for child in node.body if isinstance(child, ast.FunctionDef)}


def construction(node: ast.ClassDef) -> list[str]:
    """What a class is made of: the parameters of its __init__, or the fields of a dataclass."""
    if "__init__" in methods(node):
        return arguments(methods(node)["__init__"])
    if "dataclass" not in decorators(node):
        return []
    fields = [
        child
        for child in node.body
        if isinstance(child, ast.AnnAssign) and isinstance(child.target, ast.Name)
    ]
    return [
        ast.unparse(child.target)
        for child in fields
        if "ClassVar" not in ast.unparse(child.annotation)
    ]


def raises(node: ast.AST) -> bool:
    return any(isinstance(n, ast.Raise) and n.exc is not None for n in ast.walk(node))


def definitions(source: str) -> dict[str, Definition]:
    """Functions and classes at the top of a module, by name."""
    return {node.name: node for node in ast.parse(source).body if isinstance(node, Definition)}


def promised(source: str) -> set[str]:
    """Methods that a protocol of the module documents for every class that has them."""
    protocols = [
        n
        for n in definitions(source).values()
        if isinstance(n, ast.ClassDef) and "Protocol" in map(ast.unparse, n.bases)
    ]
    return {
        name
        for node in protocols
        for name, method in methods(node).items()
        if ast.get_docstring(method)
    }


def undocumented(source: str, name: str) -> list[str]:
    """What the docstring of a public function or class lacks of the numpydoc sections that apply to it."""
    node = definitions(source)[name]
    sections = numpydoc_sections(ast.get_docstring(node) or "")
    missing = [] if ast.get_docstring(node) else ["docstring"]
    if isinstance(node, ast.ClassDef):
        told = described(sections.get("Parameters", "")) + described(sections.get("Attributes", ""))
        missing += [f"field {field}" for field in construction(node) if field not in told]
        made = [m for n, m in methods(node).items() if n in ("__init__", "__post_init__")]
        missing += ["Raises"] if any(map(raises, made)) and "Raises" not in sections else []
        public = [
            m
            for n, m in methods(node).items()
            if not n.startswith("_") and n not in promised(source)
        ]
        return missing + [f"docstring of {m.name}" for m in public if not ast.get_docstring(m)]
    if arguments(node) and "Parameters" not in sections:
        missing.append("Parameters")
    if (
        node.returns is not None
        and ast.unparse(node.returns) != "None"
        and "Returns" not in sections
    ):
        missing.append("Returns")
    return missing + (["Raises"] if raises(node) and "Raises" not in sections else [])


def disagreements(source: str) -> list[str]:
    """Functions and classes whose section Parameters does not name exactly their parameters, in their order."""
    wrong = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, Definition):
            sections = numpydoc_sections(ast.get_docstring(node) or "")
            wanted = construction(node) if isinstance(node, ast.ClassDef) else arguments(node)
            if "Parameters" in sections and described(sections["Parameters"]) != wanted:
                wrong.append(node.name)
    return wrong


def defined_in(name: str) -> str:
    """The module in which a public name is defined."""
    return str(getattr(bayesfred, name).__module__)


PUBLIC = [name for name in bayesfred.__all__ if name != "commands"]


def test_public_names_exist() -> None:
    assert len(set(bayesfred.__all__)) == len(bayesfred.__all__) > 15
    assert [name for name in bayesfred.__all__ if not getattr(bayesfred, name).__doc__] == []
    assert set(bayesfred.__all__) <= set(dir(bayesfred))


def test_stub_names_what_it_imports() -> None:
    """The stub is what a type checker and `lazy_loader` read: its __all__ and its imports are one list."""
    tree = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    names = [
        alias.asname or alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]
    stated = [ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign)]
    assert stated == [sorted(names)]
    assert stated == [sorted(bayesfred.__all__)]


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_are_documented(name: str) -> None:
    assert undocumented(SOURCES[defined_in(name)], name) == []


@pytest.mark.parametrize(
    "name", ["compare", "demo", "fit", "report", "simulate_frame", "study", "verify"]
)
def test_runs_are_documented(name: str) -> None:
    assert undocumented(SOURCES["bayesfred.commands"], name) == []


@pytest.mark.parametrize("module", SOURCES)
def test_documented_parameters_are_those_of_the_signature(module: str) -> None:
    assert disagreements(SOURCES[module]) == []


GOOD = textwrap.dedent('''
    def f(x: int, *, y: int = 0) -> int:
        """Add.

        Parameters
        ----------
        x, y : int
            Numbers.

        Returns
        -------
        int

        Raises
        ------
        ValueError
            Never.
        """
        raise ValueError

    @dataclass(frozen=True)
    class C:
        """A value.

        Attributes
        ----------
        x : int
        y : int
        """
        x: int
        y: int
        z: ClassVar[int] = 0

        def g(self) -> None:
            """Do nothing."""
''')


def test_good_documentation_passes() -> None:
    assert undocumented(GOOD, "f") == undocumented(GOOD, "C") == disagreements(GOOD) == []
    protocol = 'class P(Protocol):\n    def g(self) -> None:\n        """Do nothing."""\n'
    assert undocumented(GOOD.replace('"""Do nothing."""', "pass") + protocol, "C") == []


@pytest.mark.parametrize(
    ("name", "old", "new", "lacking"),
    [
        ("f", "    Parameters\n    ----------\n", "", "Parameters"),
        ("f", "    Returns\n    -------\n", "", "Returns"),
        ("f", "    Raises\n    ------\n", "", "Raises"),
        ("f", '"""Add', 'x = """Add', "docstring"),
        ("C", "    y : int\n", "", "field y"),
        ("C", "    y: int\n", "    y: int\n    w: int\n", "field w"),
        ("C", '"""Do nothing."""', "pass", "docstring of g"),
        (
            "C",
            "def g(self) -> None:",
            "def __init__(self):\n        raise ValueError\n    def g(self) -> None:",
            "Raises",
        ),
    ],
)
def test_lack_of_documentation_is_seen(name: str, old: str, new: str, lacking: str) -> None:
    assert GOOD.count(old) == 1
    assert lacking in undocumented(GOOD.replace(old, new), name)


@pytest.mark.parametrize(
    ("old", "new"),
    [("x, y : int", "x : int"), ("x, y : int", "y, x : int"), ("y: int = 0", "w: int = 0")],
)
def test_disagreement_is_seen(old: str, new: str) -> None:
    assert disagreements(GOOD.replace(old, new)) == ["f"]


def has_heading(source: str) -> bool:
    """Whether a module says, in a sentence at least, what it is for."""
    return (ast.get_docstring(ast.parse(source)) or "").endswith(".")


@pytest.mark.parametrize("module", SOURCES)
def test_modules_open_with_a_paragraph(module: str) -> None:
    assert has_heading(SOURCES[module])


def test_missing_heading_is_seen() -> None:
    assert not has_heading("import math\n")
    assert not has_heading('import math\n"""Sums of things."""\n')


# --------------------------------------------------------------------------------------------------

HEAVY = (
    "arviz_base",
    "arviz_stats",
    "astropy",
    "emcee",
    "h5py",
    "matplotlib",
    "numba",
    "pydantic",
    "scipy",
)


def loaded(code: str) -> set[str]:
    """The heavy packages that a fresh interpreter has loaded after running some code."""
    report = f"\nimport sys\nprint('loaded', *(name for name in {HEAVY} if name in sys.modules))"
    env = {name: value for name, value in os.environ.items() if name != "EAGER_IMPORT"}
    done = subprocess.run(
        [sys.executable, "-c", code + report], env=env, capture_output=True, text=True, check=True
    )
    return set(done.stdout.splitlines()[-1].split()[1:])


def test_heavy_packages_are_loaded_when_they_are_needed() -> None:
    assert loaded("import bayesfred") == set()
    assert loaded("import bayesfred\nbayesfred.InputError, dir(bayesfred)") == set()
    assert (
        loaded(
            "from bayesfred.cli import app\ntry:\n    app(['--help'])\nexcept SystemExit:\n    pass"
        )
        == set()
    )


def test_heavy_package_is_seen() -> None:
    assert "scipy" in loaded("import bayesfred\nbayesfred.Detector")


# Modules longer than this, and why they are not cut.
LONGEST = 400
LONG = {
    "bayesfred.model.posterior": "one class, whose methods share the frame as the loops read it",
    "bayesfred.settings": "one record a section, most of it what the fields mean",
    "bayesfred.io.files": "three formats of frames and two of catalogues, most of it what damaged "
    "files get wrong",
    "bayesfred.reporting.plots": "nine independent figures with one style",
    "bayesfred.commands": "one function a command, and what they share",
}


def long_modules(sources: Mapping[str, str]) -> set[str]:
    return {name for name, source in sources.items() if len(source.splitlines()) > LONGEST}


def test_modules_are_short() -> None:
    assert long_modules(SOURCES) - set(LONG) == set()
    assert set(LONG) - long_modules(SOURCES) == set(), "no longer long: take it off the list"


def test_long_module_is_seen() -> None:
    assert long_modules({"a": "x = 1\n" * 401, "b": "x = 1\n" * 400}) == {"a"}


MACHINE_PATH = re.compile(r"(?<![\w.<])/(?:work|tmp|home|root|Users|mnt)\b|\.\./shared|\b[A-Z]:\\")
TEXTS = [
    *(
        path
        for folder in ("bayesfred", "examples", "chains")
        for path in sorted((ROOT / folder).rglob("*"))
    ),
    *(path for path in sorted(ROOT.iterdir()) if path.suffix in (".md", ".toml")),
]


def machine_paths(text: str) -> list[str]:
    """Places that exist on one machine only."""
    return MACHINE_PATH.findall(text)


def test_no_paths_of_one_machine() -> None:
    """Kept runs, which git ignores, are no text of the project."""
    texts = [
        path
        for path in TEXTS
        if path.suffix in (".py", ".pyi", ".toml", ".md") or path.name == "template.html"
    ]
    assert ROOT / "README.md" in texts
    assert {
        path.name: found
        for path in texts
        if (found := machine_paths(path.read_text(encoding="utf-8")))
    } == {}


@pytest.mark.parametrize(
    "text",
    ["in /work", "'/work/main'", "open('/tmp/x')", "(../shared/data)", "/home/me/x", r"C:\data"],
)
def test_machine_path_is_seen(text: str) -> None:
    assert len(machine_paths(text)) == 1


def test_other_slashes_are_no_machine_paths() -> None:
    assert (
        machine_paths("e-/adu, https://example.org/home/x, tests/work, and/or, 1/tmp, </root>")
        == []
    )

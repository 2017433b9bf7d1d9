"""The one way in which objects are stored: what comes back, and what hostile content does."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, Protocol

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from test_model import make_model, make_posterior, make_truth

import bayesfred as bf
from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io.sealed import FORMAT
from bayesfred.io.serialize import kinds, read, serializable, write
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate


class Shape(Protocol):
    """Something with an area."""

    @property
    def area(self) -> float: ...


@serializable("test.square")
@dataclass(frozen=True)
class Square:
    side: float

    def __post_init__(self) -> None:
        if self.side < 0:
            raise InputError(f"side: got {self.side}, expected >= 0")

    @property
    def area(self) -> float:
        return self.side**2


@serializable("test.point")
@dataclass(frozen=True)
class Point:
    name: str


@serializable("test.everything")
@dataclass(frozen=True, eq=False)
class Everything:
    shape: Shape
    point: Point | None
    array: Floats
    terms: tuple[tuple[int, ...], ...]
    labels: tuple[str, ...]
    mode: Literal["a", "b"]
    flag: bool
    number: int
    length: float | None
    prior: Mapping[str, Any]


def everything(**changes: Any) -> Everything:
    return Everything(
        **{
            "shape": Square(2.0),
            "point": Point("é \U0001f52d"),
            "array": np.arange(6.0).reshape(2, 3),
            "terms": ((1, 0), (0, 2)),
            "labels": ("f_ux", "ü"),
            "mode": "b",
            "flag": True,
            "number": -3,
            "length": None,
            "prior": {"z": stats.norm(1.0, 2.0), "a.b": stats.gamma(2, scale=3.0), "m": {"x": 1.5}},
        }
        | changes
    )


@pytest.fixture
def group() -> Iterator[h5py.Group]:
    with h5py.File(io.BytesIO(), "w", libver=FORMAT) as file:
        yield file.create_group("there")


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal, field by field and bit by bit."""
    if hasattr(a, "dist"):
        x = np.linspace(-5.0, 9.0, 50)
        return a.dist.name == b.dist.name and np.array_equal(a.logpdf(x), b.logpdf(x))
    if isinstance(a, Mapping):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=True)
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a)
        )
    return type(a) is type(b) and bool(a == b or (a != a and b != b))


# --- what comes back ------------------------------------------------------------------------------


def test_everything_comes_back(group: h5py.Group) -> None:
    write(group, everything())
    assert same(read(group, Everything), everything())
    assert not same(everything(number=-4), everything())
    assert not same(everything(prior={}), everything())


@pytest.mark.parametrize(
    "changes",
    [
        {"point": None, "length": 0.1, "terms": (), "labels": (), "prior": {}},
        {"point": Point(""), "array": np.zeros((0, 4)), "flag": False},
        {"array": np.array([np.nan, -np.inf, -0.0]), "length": float("nan"), "mode": "a"},
        {"terms": ((), ()), "number": 2**63 - 1, "prior": {"none": None, "text": "x"}},
        {"prior": {str(name): 0.0 for name in ("b", "a", "c")}},  # the order is kept
        {"prior": {"background": stats.truncnorm(-1.0, 2.0, loc=3.0, scale=0.5)}},
        {"prior": {"array": np.array([1, 2]), "mask": np.array([True, False]), "p": Square(1.0)}},
        {"array": np.arange(4.0).astype(">f8")},
    ],
)
def test_odd_values_come_back(group: h5py.Group, changes: dict[str, Any]) -> None:
    write(group, everything(**changes))
    again = read(group, Everything)
    if not np.asarray(changes.get("array", 0.0)).dtype.isnative:
        assert again.array.dtype.isnative and np.array_equal(again.array, changes["array"])
        return
    if changes.get("terms") == ((), ()):  # of nothing a shape remains
        assert again.terms == ((), ())
    assert same(again, everything(**changes))


def test_arrays_have_checksums_and_nothing_is_compressed(group: h5py.Group) -> None:
    write(group, everything())
    arrays: list[h5py.Dataset] = []
    group.visititems(
        lambda _, item: arrays.append(item) if isinstance(item, h5py.Dataset) else None
    )
    assert {item.name.rsplit("/")[-1] for item in arrays} == {"array", "terms"}
    assert all(item.fletcher32 and item.compression is None for item in arrays)


def test_the_package_comes_back(group: h5py.Group) -> None:
    rng = np.random.default_rng(7)
    model = make_model()
    posterior, _ = make_posterior(model, make_truth(model, rng), rng)
    write(group, posterior)
    again = read(group, Posterior)
    assert again.nuisances == posterior.nuisances and again.noise == posterior.noise
    assert same(again.model, posterior.model) and same(again.prior, posterior.prior)
    assert np.array_equal(again.mask, posterior.mask)
    logarithm = bf.ForwardModel(
        model.detector, model.sources, bf.MoffatPSF(4.0, 3.0), bf.LogDistortion(1e-5)
    )
    for k, value in enumerate(
        (logarithm, bf.SampledPSF(np.ones((3, 3)), 4), bf.BackgroundNoise(), bf.PoissonNoise(2.0))
    ):
        write(group.create_group(f"of{k}"), value)
        assert same(read(group[f"of{k}"], object), value)


def test_kinds_of_a_section() -> None:
    assert (
        kinds("psf")["gaussian"] is bf.GaussianPSF and kinds("noise")["poisson"] is bf.PoissonNoise
    )
    assert list(kinds("test")) == sorted(kinds("test")) and kinds("no_such") == {}


@serializable("test.cached")
@dataclass(frozen=True)
class Cached:
    side: float
    area: float | None = field(default=None, metadata={"stored": False})


def test_a_field_may_be_left_out(group: h5py.Group) -> None:
    write(group, Cached(2.0, 4.0))
    assert set(group.attrs) == {"kind", "side"}
    assert read(group, Cached) == Cached(2.0)


# --- what files cannot hold -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"shape": object()},
        {"shape": np.array(["x"])},
        {"array": np.array([object()])},
        {"terms": ((1, 2), (3,))},
        {"terms": ((1, "a"),)},
        {"prior": {"a/b": 1.0}},
        {"prior": {"kind": 1.0}},
        {"prior": {".": 1.0}},
        {"prior": {"n": stats.poisson(3.0)}},
        {"prior": {"n": stats.rv_histogram((np.ones(3), np.arange(4.0)))()}},
    ],
)
def test_what_cannot_be_stored_is_refused(group: h5py.Group, changes: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"files cannot hold|of your own"):
        write(group, everything(**changes))


def test_classes_that_cannot_be_registered() -> None:
    with pytest.raises(TypeError, match="taken"):
        serializable("test.square")(Point)
    with pytest.raises(TypeError, match="taken"):
        serializable("mapping")(Point)
    with pytest.raises(TypeError, match="expected a dataclass"):
        serializable("test.int")(int)


# --- hostile content ------------------------------------------------------------------------------

Harm = Callable[[h5py.Group], object]


def put(group: h5py.Group, name: str, value: Any) -> None:
    """Store a value in place of whatever has this name."""
    if name in group:
        del group[name]
    group.attrs.pop(name, None)
    if isinstance(value, np.ndarray) and name not in ("keys", "mode", "parameters"):
        group[name] = value
    elif isinstance(value, Square | Point | Everything):
        write(group.create_group(name), value)
    elif value is group:
        group.create_group(name)
    else:
        group.attrs[name] = value


def nested(group: h5py.Group) -> None:
    inner = group["prior"]
    for _ in range(3000):
        inner.attrs["kind"], inner.attrs["keys"] = np.bytes_("mapping"), np.array([b"m"])
        inner = inner.require_group("m") if "m" not in inner.attrs else inner.create_group("x")
    inner.attrs["kind"] = np.bytes_("mapping")


HARM: dict[str, tuple[Harm, str]] = {
    "no kind": (lambda g: g.attrs.pop("kind"), "without a kind"),
    "kind of numbers": (lambda g: put(g, "kind", 3.0), "without a kind"),
    "unknown kind": (lambda g: put(g, "kind", np.bytes_("os.system")), "unknown kind 'os.system'"),
    "another kind": (lambda g: put(g, "kind", np.bytes_("test.square")), "side: no value"),
    "a kind that is not expected": (
        lambda g: [put(g, "kind", np.bytes_("test.point")), put(g, "name", np.bytes_("x"))],
        "got Point, expected Everything",
    ),
    "kind of bytes": (lambda g: put(g, "kind", np.bytes_(b"\xff\xfe")), "kind"),
    "missing array": (lambda g: g.__delitem__("array"), "array: no value"),
    "missing attribute": (lambda g: g.attrs.pop("flag"), "flag: no value"),
    "missing group": (lambda g: g.__delitem__("shape"), "shape: no value"),
    "text for an array": (lambda g: put(g, "array", np.bytes_("x")), "array: got 'x'"),
    "None for an array": (lambda g: put(g, "array", h5py.Empty("f8")), "array: got None"),
    "group for an array": (lambda g: put(g, "array", g), "without a kind"),
    "object for an array": (lambda g: put(g, "array", Square(1.0)), "array: got"),
    "array for an object": (lambda g: put(g, "shape", np.zeros(3)), "shape: got"),
    "wrong object": (lambda g: put(g, "shape", Point("x")), "shape: got"),
    "wrong union": (lambda g: put(g, "point", Square(1.0)), "point: got"),
    "itself": (lambda g: put(g, "point", everything()), "point: got"),
    "refused by its class": (lambda g: put(g["shape"], "side", -1.0), "side: got -1.0"),
    "text for a number": (lambda g: put(g, "number", np.bytes_("3")), "number: got '3'"),
    "float for an integer": (lambda g: put(g, "number", 3.5), "number: got 3.5"),
    "boolean for a number": (lambda g: put(g, "length", True), "length: got True"),
    "numbers for a number": (lambda g: put(g, "number", [1, 2]), "number: got"),
    "number for a boolean": (lambda g: put(g, "flag", 1), "flag: got 1"),
    "no such choice": (lambda g: put(g, "mode", np.bytes_("c")), "mode: got 'c'"),
    "choices": (lambda g: put(g, "mode", np.array([b"a", b"b"])), "mode: got"),
    "text that is none": (lambda g: put(g["point"], "name", np.bytes_(b"\xff")), "name"),
    "array for a tuple": (lambda g: put(g, "terms", np.zeros((2, 2))), "terms: got"),
    "number for a mapping": (lambda g: put(g, "prior", 1.0), "prior: got 1.0"),
    "mapping without keys": (lambda g: g["prior"].attrs.pop("keys"), "keys: no value"),
    "keys of numbers": (lambda g: put(g["prior"], "keys", [1.0, 2.0]), "without keys"),
    "one text for keys": (lambda g: put(g["prior"], "keys", np.bytes_("z")), "without keys"),
    "missing key": (lambda g: put(g["prior"], "keys", np.array([b"z", b"y"])), "y: no value"),
    "keys outside": (lambda g: put(g["prior"], "keys", np.array([b"../shape"])), "no value"),
    "family of another library": (
        lambda g: put(g["prior/z"], "family", np.bytes_("rv_histogram")),
        "unknown family 'rv_histogram'",
    ),
    "discrete family": (lambda g: put(g["prior/z"], "family", np.bytes_("poisson")), "family"),
    "family that is a function": (
        lambda g: put(g["prior/z"], "family", np.bytes_("kstest")),
        "kst",
    ),
    "family of numbers": (lambda g: put(g["prior/z"], "family", 1.0), "unknown family 1.0"),
    "too few parameters": (lambda g: put(g["prior/z"], "parameters", [1.0]), "parameters"),
    "too many parameters": (lambda g: put(g["prior/z"], "parameters", [1.0] * 4), "nothing can be"),
    "parameters of texts": (lambda g: put(g["prior/z"], "parameters", np.bytes_("1")), "param"),
    "parameters of many texts": (
        lambda g: put(g["prior/z"], "parameters", np.array([b"1", b"2"])),
        "parameters",
    ),
    "infinite parameters": (lambda g: put(g["prior/z"], "parameters", [0.0, np.inf]), "param"),
    "negative scale": (
        lambda g: put(g["prior/z"], "parameters", [0.0, -1.0]),
        "valid ones of norm",
    ),
    "table of parameters": (
        lambda g: put(g["prior/z"], "parameters", np.ones((2, 2))),
        "parameters",
    ),
    "impossible shape": (
        lambda g: put(g["prior/a.b"], "parameters", [-2.0, 0.0, 1.0]),
        "valid ones of gamma",
    ),
    "texts in an array": (lambda g: put(g, "array", np.array([b"x"])), "array: got values of type"),
    "compound numbers": (
        lambda g: put(g, "array", np.zeros(2, [("a", "f8")])),
        "array: got values",
    ),
    "a reference": (lambda g: put(g, "number", g.ref), "number"),
    "deep nesting": (nested, "nested too deeply"),
}


@pytest.mark.parametrize("name", HARM)
def test_harm_is_one_line(group: h5py.Group, name: str) -> None:
    do, words = HARM[name]
    write(group, everything())
    do(group)
    with pytest.raises(InputError) as caught:
        read(group, Everything)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_what_nothing_reads_is_left_alone(group: h5py.Group) -> None:
    write(group, everything())
    group.attrs["colour"] = 1.0
    group.create_group("other")
    assert same(read(group, Everything), everything())


def paths(group: h5py.Group) -> list[tuple[str, str | None]]:
    """Every array and group, and every attribute."""
    found: list[tuple[str, str | None]] = []

    def add(name: str, item: Any) -> None:
        found.extend([(name, None), *((name, key) for key in item.attrs)])

    add("/", group)
    group.visititems(add)
    return found


JUNK = st.one_of(
    st.floats(),
    st.integers(-(2**63), 2**63 - 1),
    st.booleans(),
    st.binary(min_size=1, max_size=20).map(np.bytes_),
    st.just(h5py.Empty("f8")),
    st.lists(st.floats(), max_size=4).map(np.array),
    st.sampled_from([b"mapping", b"distribution", b"tuple", b"posterior", b"noise.poisson"]).map(
        np.bytes_
    ),
)


@pytest.mark.slow
@settings(max_examples=300, derandomize=True, deadline=None)
@given(st.data())
def test_any_spoilt_posterior_is_read_or_refused_in_one_line(data: st.DataObject) -> None:
    model = bf.ForwardModel(
        bf.Detector((9, 9)), bf.SourceCatalog([0.0], [0.0], [1e3]), bf.GaussianPSF(1.5),
        bf.PolynomialDistortion([(1, 0, 1, 0)], []),
    )  # fmt: skip
    estimate = MapEstimate(np.zeros(2), np.eye(2), -1.0, 3, "message")
    with h5py.File(io.BytesIO(), "w", libver=FORMAT) as file:
        write(file.create_group("a"), Posterior(model, np.ones((9, 9))))
        write(file.create_group("b"), estimate)
        for _ in range(data.draw(st.integers(1, 3))):
            name, key = data.draw(st.sampled_from(paths(file["a"]) + paths(file["b"])))
            part = "a" if name in file["a"] else "b"
            if name not in file[part]:
                continue
            item = file[part][name]
            if key is not None:
                item.attrs[key] = data.draw(JUNK)
            elif name != "/":
                value = data.draw(JUNK | st.none())
                parent, last = item.parent, item.name.rsplit("/", 1)[-1]
                del parent[last]
                if value is not None and not isinstance(value, h5py.Empty):
                    parent[last] = value
        for part, expected in (("a", Posterior), ("b", MapEstimate)):
            message = ""
            try:
                assert isinstance(read(file[part], expected), expected)
            except InputError as error:
                message = str(error)
            assert message.isprintable()

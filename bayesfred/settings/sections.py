"""Sections of a run file that describe objects, and what is said of a section with a mistake.

The keys of such a section are the fields of a class: :func:`described` makes the pydantic model of
the section from the class, and the class checks the values. So a new PSF family or noise model,
registered with `bayesfred.io.serialize`, can be named in a run file without a change here.
`[distortion]`, which names or lists terms, has a model of its own.
"""

from __future__ import annotations

import difflib
import inspect
import json
import re
import reprlib
import types
from dataclasses import MISSING, fields
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, create_model, model_validator

# imported to be registered: the families that the package brings
import bayesfred.imaging.psf  # noqa: F401
import bayesfred.model.noise  # noqa: F401
from bayesfred.errors import InputError
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.io.serialize import kinds
from bayesfred.model.parameters import Nuisances

__all__ = [
    "TOO_DEEP",
    "Count",
    "DistortionSettings",
    "Float",
    "Name",
    "NotNegative",
    "ObjectSettings",
    "Positive",
    "Section",
    "Seed",
    "described",
    "mistake",
    "model_of",
    "toml",
]

# Far outside what frames need, and far inside what float64, int64 and memory hold.
LARGEST = 1e15
Name = Annotated[str, Field(min_length=1, max_length=1000)]
Float = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NotNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Count = Annotated[int, Field(ge=1, le=10**15)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Integer = Annotated[int, Field(ge=-(10**15), le=10**15)]

_Power = Annotated[int, Field(ge=0, le=10)]
_Term = tuple[_Power, _Power, _Power, _Power]
_Basis = Literal[
    "mirrored", "paper", "pinhole", "radial_tangential", "polynomial", "full_polynomial", "zernike",
    "choose",
]  # fmt: skip
_WITH_DEGREE = ("polynomial", "full_polynomial", "zernike")
FIRST_CHOICE = 3  # degree of the polynomial with which outliers are rejected before one is chosen

TOO_DEEP = "got tables or arrays nested too deeply, expected sections of key = value"

# The class of a section; or the kind that it has by default, where a key `kind` chooses the class.
CLASSES: dict[str, type] = {"detector": Detector, "nuisances": Nuisances}
DEFAULT_KINDS = {"psf": "gaussian", "noise": "poisson"}

# What a frame or an image supplies is not known yet when a run file is checked.
STAND_INS: dict[type, dict[str, Any]] = {Detector: {"shape": (1, 1)}}
STAND_IN_IMAGE = np.ones((3, 3))


class Section(BaseModel):
    """A table of a run file; its fields are the keys."""

    # strict: TOML has types of its own, so 'true' or '3' is never taken for a number.
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, protected_namespaces=()
    )


class DistortionSettings(Section):
    """`[distortion]`: the terms of f and g, named as a basis or listed.

    Attributes
    ----------
    terms : str, optional
        A basis by name: a constructor of `PolynomialDistortion`; or 'choose': the polynomial that
        `bayesfred.choose_terms` chooses.
    degree : int, optional
        Highest degree of a 'polynomial', 'full_polynomial' or 'zernike' basis.
    f_terms, g_terms : tuple of (i, j, m, n), optional
        Powers of x, y, u, v, one entry a term.
    """

    terms: _Basis | None = None
    degree: Annotated[int, Field(ge=1, le=10)] | None = None
    f_terms: tuple[_Term, ...] | None = None
    g_terms: tuple[_Term, ...] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> DistortionSettings:
        given = [key for key in ("terms", "f_terms", "g_terms") if getattr(self, key) is not None]
        if given not in (["terms"], ["f_terms", "g_terms"]):
            got = " and ".join(given) or "no terms"
            raise ValueError(f"got {got}, expected either terms, or both f_terms and g_terms")
        if self.terms in _WITH_DEGREE and self.degree is None:
            raise ValueError(f"got no degree, expected one with terms = {self.terms!r}")
        if self.terms not in _WITH_DEGREE and self.degree is not None:
            names = " or ".join(map(repr, _WITH_DEGREE))
            raise ValueError(f"got degree {self.degree}, expected it with terms = {names} only")
        if not self.terms and not self.f_terms and not self.g_terms:
            raise ValueError("got f_terms and g_terms empty, expected at least one term")
        self.make(1.0)
        return self

    def make(self, radius: float) -> PolynomialDistortion:
        """Make the distortion.

        Parameters
        ----------
        radius : float, pixel
            Half the frame's diagonal, for the bases that need a unit of length.

        Raises
        ------
        InputError
            A term is not allowed, or the degree is too low.
        """
        if self.terms == "choose":  # to begin with
            return PolynomialDistortion.polynomial(FIRST_CHOICE)
        if self.terms is None:
            return PolynomialDistortion(self.f_terms or (), self.g_terms or ())
        keywords: dict[str, Any] = {} if self.degree is None else {"degree": self.degree}
        if self.terms == "zernike":
            keywords["radius"] = radius
        made: PolynomialDistortion = getattr(PolynomialDistortion, self.terms)(**keywords)
        return made


class ObjectSettings(Section):
    """A section whose keys are the fields of a class.

    In place of a field that holds an array, the key `path` names the file of an image.

    Attributes
    ----------
    made : type
        The class.
    given : dict
        Fields that are no keys, with stand-ins.
    """

    made: ClassVar[type]
    given: ClassVar[dict[str, Any]]

    def make(self, **given: Any) -> Any:
        """Make the object; `given` are the fields that are no keys of the section.

        Raises
        ------
        InputError
            The class refuses a value.
        """
        names = {field.name for field in fields(self.made)} & set(type(self).model_fields)
        return self.made(**given, **{name: getattr(self, name) for name in names})

    @model_validator(mode="after")
    def _accepted_by_the_class(self) -> ObjectSettings:
        try:
            self.make(**self.given)
        except InputError as error:
            # what is wrong with a stand-in is wrong with no key
            if not self.given or any(
                f"{key}: got" in str(error) for key in type(self).model_fields
            ):
                raise
        return self


@cache
def _describing(made: type, kind: str | None = None) -> type[ObjectSettings]:
    """The section that describes objects of a class."""
    hints = get_type_hints(made)
    keys: dict[str, Any] = {} if kind is None else {"kind": (Literal[kind], kind)}
    given = dict(STAND_INS.get(made, {}))
    for field in fields(made):
        key = _key(hints[field.name])
        if key is None:
            given[field.name], keys["path"] = STAND_IN_IMAGE, (Name, ...)
        elif field.name not in given:
            keys[field.name] = (key, ... if field.default is MISSING else field.default)
    model: type[ObjectSettings] = create_model(made.__name__, __base__=ObjectSettings, **keys)
    model.made, model.given = made, given
    return model


def _key(hint: Any) -> Any:
    """The type of a key from that of a field, within bounds; None for an array."""
    if get_origin(hint) in (Union, types.UnionType):
        return Union[tuple(key for key in map(_key, get_args(hint)) if key is not None)]  # noqa: UP007
    if get_origin(hint) is np.ndarray:
        return None
    return {float: Float, int: Integer, str: Name}.get(hint, hint)


def model_of(section: str, table: Any) -> type[ObjectSettings]:
    """The model of a section that describes an object, which may depend on the table's `kind`."""
    if section in CLASSES:
        return _describing(CLASSES[section])
    known, kind = kinds(section), DEFAULT_KINDS[section]
    if isinstance(table, dict):
        kind = table.get("kind", kind)
    if not isinstance(kind, str) or kind not in known:
        *most, last = map(repr, known)
        raise ValueError(f"kind: got {reprlib.repr(kind)}, expected {', '.join(most)} or {last}")
    return _describing(known[kind], kind)


def described(section: str, table: Any) -> ObjectSettings:
    """Check the table of a section that describes an object.

    Parameters
    ----------
    section : str
        One of `detector`, `psf`, `noise` and `nuisances`.
    table : dict
        As read from JSON.

    Returns
    -------
    ObjectSettings

    Raises
    ------
    ValidationError, ValueError
        With every mistake.

    Examples
    --------
    >>> described("psf", {"kind": "moffat", "fwhm": 4.0, "beta": 3}).make()
    MoffatPSF(fwhm=4.0, beta=3.0)
    """
    return model_of(section, table).model_validate_json(json.dumps(table))


def toml(run: Section) -> str:
    """Write a run as the text of a run file, every default included.

    Parameters
    ----------
    run : Section
        The whole run file, or one section.

    Returns
    -------
    str
        TOML. Characters that cannot be shown are escaped, so that the text can be read and copied
        from a page.

    Examples
    --------
    >>> print(toml(described("psf", {"kind": "moffat", "fwhm": 4.0, "beta": 3})))
    kind = "moffat"
    fwhm = 4.0
    beta = 3.0
    """
    return _table((), run.model_dump(exclude_none=True)).strip()


def toml_text(text: str) -> str:
    """A text as TOML quotes it."""
    return _value(text)


def _table(name: tuple[str, ...], table: dict[str, Any]) -> str:
    """A table of TOML with those in it; nothing for one without keys."""
    parts = {key: part for key, part in table.items() if isinstance(part, dict)}
    many = {key: part for key, part in table.items() if _is_tables(part)}
    keys = {key: value for key, value in table.items() if key not in {**parts, **many}}
    head = f"\n[{'.'.join(map(_key_text, name))}]\n" if name and keys else ""
    return "".join(
        [
            head,
            _lines(keys),
            *(_table((*name, key), part) for key, part in parts.items()),
            *(f"\n[[{_key_text(key)}]]\n{_lines(e)}" for key, part in many.items() for e in part),
        ]
    )


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _lines(table: dict[str, Any]) -> str:
    return "".join(f"{_key_text(key)} = {_value(value)}\n" for key, value in table.items())


def _key_text(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, dict):
        inside = ", ".join(f"{_key_text(key)} = {_value(part)}" for key, part in value.items())
        return f"{{ {inside} }}"
    if isinstance(value, str):  # JSON escapes as TOML does; it leaves what cannot be shown
        text = json.dumps(value, ensure_ascii=False)
        return "".join(c if c.isprintable() else _escape(ord(c)) for c in text)
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _escape(code: int) -> str:
    return f"\\u{code:04x}" if code < 2**16 else f"\\U{code:08x}"


def mistake(details: Any, root: type[Section], table: Any) -> str:
    """Say one of pydantic's errors as `section.key: got X, expected Y`.

    Parameters
    ----------
    details : ErrorDetails
        The error.
    root : type
        The model of the whole run file.
    table : dict
        The run file.
    """
    location, kind, message = details["loc"], details["type"], details["msg"]
    where = ".".join(map(str, location))
    if kind == "json_invalid":
        return TOO_DEEP
    if kind == "missing":
        return f"{where}: missing, expected a value"
    if kind == "extra_forbidden":
        known = _known_keys(root, location[:-1], table)
        near = difflib.get_close_matches(str(location[-1]), known, n=1)
        advice = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"
        kind = DEFAULT_KINDS.get(location[0])
        of = f" with kind = {table[location[0]].get('kind', kind)!r}" if kind else ""
        return f"{where}: unknown key{of}, {advice}"
    if kind == "value_error":
        # a class begins with the name of the field, and some with that of the section before it
        text = str(details["ctx"]["error"]).removeprefix(f"{where}: ")
        key, _, rest = text.partition(": ")
        return f"{where}.{key}: {rest}" if rest and key.isidentifier() else f"{where}: {text}"
    expected = re.sub(r"^\w+ should (be )?", "", message).replace("an object", "a table")
    expected = re.sub(r"^(greater|less)", r"a number \1", re.sub(r"^have ", "one with ", expected))
    return f"{where}: got {reprlib.repr(details['input'])}, expected {expected}"


def _known_keys(root: type[Section], location: tuple[str | int, ...], table: Any) -> list[str]:
    """The keys of the section at a location in the run file."""
    section: type[BaseModel] = root
    for name in (str(part) for part in location if not isinstance(part, int)):
        if name in (*CLASSES, *DEFAULT_KINDS):
            section = model_of(name, table[name])
            continue
        annotation = section.model_fields[name].annotation
        section = next(
            candidate
            for candidate in (annotation, *get_args(annotation))
            if inspect.isclass(candidate) and issubclass(candidate, BaseModel)
        )
    return list(section.model_fields)

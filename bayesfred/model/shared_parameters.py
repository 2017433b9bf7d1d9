"""Which parameters frames share, and where each frame's are among those of all."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.io.serialize import KEY, TAGS
from bayesfred.model import priors
from bayesfred.model.posterior import Posterior


class Part(NamedTuple):
    """Where the parameters of a frame are in a vector of all parameters.

    Attributes
    ----------
    columns : ndarray of int, shape (d_i,)
        Where each of the frame's parameters is; of a drifting one its constant part.
    own : ndarray of int, shape (q_i,)
        Columns of parameters that no other frame has.
    places : ndarray of int, shape (q_i,)
        Where the latter are among the frame's parameters.
    matrix : ndarray, shape (d_i, p)
        Derivatives of the frame's parameters by the shared ones.
    """

    columns: Ints
    own: Ints
    places: Ints
    matrix: Floats


def lens_terms(frame: Posterior) -> tuple[str, ...]:
    """The distortion's terms of degree 2 and higher."""
    d = frame.model.polynomial
    degrees = np.array([sum(term) for term in (*d.f_terms, *d.g_terms)])
    basis = np.eye(d.n_terms) if d.basis is None else d.basis
    highest = np.where(basis != 0.0, degrees[:, None], 0).max(axis=0)
    terms = tuple(name for name, degree in zip(d.names, highest, strict=True) if degree >= 2)
    if not terms:
        raise InputError(
            "shared: got no terms of degree 2 or higher, expected some: name what the frames share"
        )
    return terms


def largest_displacements(frame: Posterior, shared: Sequence[str]) -> dict[str, float]:
    """By how much a unit of each shared coefficient moves a star at most, pixel."""
    d, (ny, nx) = frame.model.polynomial, frame.model.detector.fine_shape
    largest = d.largest_displacement(0.5 * nx, 0.5 * ny).max(axis=0)
    return {name: x for name, x in zip(d.names, largest, strict=True) if name in shared}


def require_names(frames: Mapping[str, Posterior]) -> None:
    """Refuse no frames, and names that files cannot hold."""
    if not frames:
        raise InputError("frames: got none, expected at least one")
    if wrong := [name for name in frames if name in TAGS or not KEY.fullmatch(name)]:
        raise InputError(
            f"frames: got the name {wrong[0]!r}, expected letters, digits, underscores and "
            "hyphens, and neither kind nor keys"
        )


def agreed_priors(
    frames: Mapping[str, Posterior], shared: Sequence[str], given: Mapping[str, Any]
) -> dict[str, Any]:
    """The priors that the frames have where none are given, by the names of all parameters.

    Raises
    ------
    InputError
        If a shared parameter is not the same in all frames, or its prior is not.
    """
    first = next(iter(frames.values()))
    for name, frame in frames.items():
        _require_same(first, name, frame, shared, given)
    own = {
        f"{name}.{parameter}": distribution
        for name, frame in frames.items()
        for parameter, distribution in frame.prior.items()
        if parameter not in shared
    }
    return {**{name: first.prior[name] for name in shared}, **own, **given}


def _require_same(
    first: Posterior, name: str, frame: Posterior, shared: Sequence[str], given: Mapping[str, Any]
) -> None:
    """Refuse a frame for which a shared parameter is another, or has another prior."""
    if missing := [each for each in shared if each not in frame.parameter_names]:
        raise InputError(
            f"shared: got {', '.join(missing)}, which frame {name} does not have, expected names "
            f"among {', '.join(frame.parameter_names)}"
        )
    one, two = first.model.polynomial, frame.model.polynomial
    if any(each in one.names for each in shared) and not (
        (one.f_terms, one.g_terms) == (two.f_terms, two.g_terms)
        and np.array_equal(np.asarray(one.basis), np.asarray(two.basis))
        and first.model.detector.binning == frame.model.detector.binning
    ):
        raise InputError(
            f"shared: got other terms or pixels in frame {name} than in the first, expected one "
            "distortion for all frames"
        )
    differ = [
        each
        for each in shared
        if each not in given and not priors.same(first.prior[each], frame.prior[each])
    ]
    if differ:
        raise InputError(
            f"prior: got another one of {', '.join(differ)} in frame {name} than in the first, "
            "expected one for all frames: give it"
        )

r"""How terms that frames share change from one frame to the next.

A drifting term has the value theta in the mean of all frames (linear) or in the first one (walk),
and in frame i

    theta_i = theta + (t_i - mean t) s            linear: the slope s is a parameter,
    theta_i = theta + d_2 + ... + d_i             walk: the steps d_j ~ N(0, r^2 (t_j - t_(j-1))),

in the order of the times. Both are linear, so that derivatives by what frames share are those by
the frames' own terms times constants, and all new parameters are shared by the frames.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable
from bayesfred.model.parameters import Parameter


class DriftColumn(NamedTuple):
    """A parameter that says how a shared one changes.

    Attributes
    ----------
    parameter : Parameter
    term : str
        The shared parameter that it is added to.
    weights : ndarray, shape (k,)
        What it is multiplied by in every frame.
    """

    parameter: Parameter
    term: str
    weights: Floats


@serializable("drift")
@dataclass(frozen=True)
class Drift:
    """Which shared parameters change with time, and how.

    Parameters
    ----------
    times : mapping of str to float
        When every frame was taken, in any unit, by the frame's name.
    terms : tuple of str
        The shared distortion coefficients that drift.
    walk : float, optional, pixel
        Without it the terms drift along straight lines in time: parameters `f_x3.drift`, per unit
        of time. With it they make a random walk, with the step before frame b as the parameter
        `f_x3.step_b`: the standard deviation, after a unit of time, of the displacement that a term
        makes where in the frame it is largest. The prior of the steps follows from it.

    Raises
    ------
    InputError
        If no term or fewer than two frames are named, a time is not finite, all times are equal,
        or `walk` is not positive.

    Examples
    --------
    >>> Drift({"a": 0.0, "b": 60.0}, ("f_x3",), walk=0.1).walk
    0.1
    """

    times: Mapping[str, float]
    terms: tuple[str, ...]
    walk: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", {name: float(t) for name, t in self.times.items()})
        object.__setattr__(self, "terms", tuple(self.terms))
        if not self.terms:
            raise InputError("drift: terms: got none, expected names of shared parameters")
        values = np.array(list(self.times.values()))
        if not np.all(np.isfinite(values)) or np.unique(values).size < 2:
            raise InputError(
                "drift: times: got fewer than two finite ones that differ, expected when each "
                "frame was taken"
            )
        if self.walk is not None and not 0.0 < self.walk < np.inf:
            raise InputError(
                f"drift: walk: got {self.walk}, expected pixels > 0 by which a term's largest "
                "displacement changes in a unit of time"
            )

    def columns(
        self, frames: Sequence[str], shared: Mapping[str, Parameter], units: Mapping[str, float]
    ) -> list[DriftColumn]:
        """The parameters of the drift.

        Parameters
        ----------
        frames : sequence of str, length k
        shared : mapping of str to Parameter
            The parameters that the frames share, with their default priors.
        units : mapping of str to float
            The largest displacement that a unit of each of them makes, pixel.

        Returns
        -------
        list of DriftColumn

        Raises
        ------
        InputError
            If a frame has no time, or a term is not a shared coefficient of the distortion.
        """
        if set(self.times) != set(frames):
            raise InputError(
                f"drift: times: got those of {', '.join(self.times)}, expected one each of "
                f"{', '.join(frames)}"
            )
        if wrong := [term for term in self.terms if term not in units]:
            raise InputError(
                f"drift: terms: got {', '.join(wrong)}, expected shared coefficients of the "
                f"distortion, such as {', '.join(list(units)[:3]) or 'none: share some'}"
            )
        t = np.array([self.times[name] for name in frames])
        if self.walk is None:
            return [
                self._column(shared[term], "drift", t - t.mean(), 1.0 / np.ptp(t))
                for term in self.terms
            ]
        order = np.argsort(t, kind="stable")
        columns = []
        for term in self.terms:
            for before, after in itertools.pairwise(order):
                if t[after] > t[before]:
                    sd = self.walk * np.sqrt(t[after] - t[before]) / units[term]
                    scale = sd / shared[term].prior.std()
                    weights = (t >= t[after]).astype(np.float64)
                    columns.append(
                        self._column(shared[term], f"step_{frames[after]}", weights, scale)
                    )
        return columns

    def _column(self, term: Parameter, what: str, weights: Floats, scale: float) -> DriftColumn:
        """A parameter whose prior is as wide as `scale` times that of its term."""
        prior = stats.norm(0.0, scale * float(term.prior.std()))
        parameter = replace(
            term, name=f"{term.name}.{what}", neutral=0.0, start=0.0, prior=prior, slot=-1
        )
        return DriftColumn(parameter, term.name, weights)

"""Where the likelihoods of several frames are evaluated.

A joint posterior asks for them through `FrameEvaluator` and adds them up in the order of its
frames. So its answers do not depend on who evaluates which frame, or when.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.model.likelihood import FrameLikelihood
from bayesfred.model.posterior import Posterior


class FrameEvaluator(Protocol):
    """Evaluates the likelihoods of k frames, each of parameters of its own."""

    def log_likelihood(self, vectors: Sequence[Floats], wanted: Flags) -> Floats:
        """Log-likelihood of every frame.

        Parameters
        ----------
        vectors : sequence of ndarray, length k
            Parameter vectors of every frame, shape (n, d_i).
        wanted : ndarray of bool, shape (k, n)

        Returns
        -------
        ndarray, shape (k, n)
            -inf where it is not wanted, or where the distortion has no density.
        """
        ...

    def derivatives(self, vectors: Sequence[Floats]) -> list[tuple[Floats, Floats]]:
        """Gradient and Fisher information of every frame's log-likelihood.

        Parameters
        ----------
        vectors : sequence of ndarray, length k
            One parameter vector of every frame, shape (d_i,).

        Returns
        -------
        list of tuple, length k
            Shapes (d_i,) and (d_i, d_i); NaN where there is no density.
        """
        ...

    def near(self, params: Sequence[Floats], covariances: Sequence[Floats]) -> Self:
        """The same likelihoods, prepared to be evaluated often around `params`.

        Parameters
        ----------
        params : sequence of ndarray, length k, shape (d_i,)
        covariances : sequence of ndarray, length k, shape (d_i, d_i)
            How far around.
        """
        ...


@dataclass(frozen=True, eq=False)
class LocalFrames:
    """Frames that are evaluated in this process, one after the other.

    The parameter vectors of a frame are shared among as many threads as numba may use. Frames of
    one kind use the same buffers.

    Parameters
    ----------
    frames : mapping of str to Posterior
    closer : tuple of FrameLikelihood, optional
        Their likelihoods where others are to be used, see `near`.
    """

    frames: Mapping[str, Posterior]
    closer: tuple[FrameLikelihood, ...] = ()

    def __post_init__(self) -> None:
        for likelihood in self._likelihoods:  # before a frame has made buffers of its own
            likelihood.share_workspaces(self._likelihoods[0])

    def log_likelihood(self, vectors: Sequence[Floats], wanted: Flags) -> Floats:
        """Log-likelihood of every frame, see `FrameEvaluator`."""
        out = np.full(wanted.shape, -np.inf)
        for likelihood, own, some, row in zip(self._likelihoods, vectors, wanted, out, strict=True):
            if some.any():
                row[some] = likelihood.log_likelihood(own[some], np.ones(some.sum(), bool))
        return out

    def derivatives(self, vectors: Sequence[Floats]) -> list[tuple[Floats, Floats]]:
        """Gradient and Fisher information of every frame, see `FrameEvaluator`."""
        return [
            (likelihood.gradient(own), likelihood.fisher(own))
            for likelihood, own in zip(self._likelihoods, vectors, strict=True)
        ]

    def near(self, params: Sequence[Floats], covariances: Sequence[Floats]) -> "LocalFrames":
        """The same frames with faster likelihoods around some parameters, see `Posterior.near`."""
        given = zip(self._likelihoods, params, covariances, strict=True)
        return LocalFrames(self.frames, tuple(each.near(own, c) for each, own, c in given))

    @cached_property
    def _likelihoods(self) -> tuple[FrameLikelihood, ...]:
        return self.closer or tuple(frame.likelihood for frame in self.frames.values())

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

"""Parts of several frames by their sources, each frame's as in `folds`.

A source that several frames show is in the same fold in all of them: its error in the catalogue is
one error, which would be in both halves if it were in one fold here and in another one there. A
source is known by its place on the sky, or in the object plane where that is not on the sky. In
every frame the sources that no frame before has shown are dealt along the path of `folds`, each to
a fold that has the fewest of the frame so far. Of one frame these are the folds of `fold_sources`.

One frame and several are treated alike here: `frame_views` lists the frames of a posterior, each
with the linear map that gives its parameters.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.analysis.folds import Folds, share_pixels, visible
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.model.joint import JointPosterior
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.joint_map import with_frames

__all__ = [
    "AnyPosterior",
    "FrameFolds",
    "FrameView",
    "are_scales",
    "columns_of",
    "fold_frames",
    "frame_views",
    "require_visible",
]

AnyPosterior = Posterior | JointPosterior

DIGITS = 7  # degrees or pixels: a star of one catalogue differs by rounding alone


class FrameView(NamedTuple):
    """A frame of a posterior.

    Attributes
    ----------
    name : str
        Empty where there is one frame.
    posterior : Posterior
        Of the frame alone; its priors are not those of a `JointPosterior`.
    to_frame : ndarray, shape (d_i, d)
        Times all parameters these are the frame's.
    """

    name: str
    posterior: Posterior
    to_frame: Floats


def frame_views(posterior: AnyPosterior) -> list[FrameView]:
    """The frames of a posterior, one or several.

    Parameters
    ----------
    posterior : Posterior or JointPosterior

    Returns
    -------
    list of FrameView
    """
    if not isinstance(posterior, JointPosterior):
        return [FrameView("", posterior, np.eye(posterior.n_parameters))]
    views = []
    for (name, frame), part in zip(posterior.frames.items(), posterior.parts, strict=True):
        to_frame = np.zeros((part.columns.size, posterior.n_parameters))
        to_frame[:, : posterior.n_shared] = part.matrix
        to_frame[part.places, part.own] = 1.0
        views.append(FrameView(name, frame, to_frame))
    return views


def columns_of(posterior: AnyPosterior, wanted: Callable[[Posterior], Flags]) -> Flags:
    """Parameters on which some of the frames' depend.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
    wanted : callable
        Which of a frame's parameters are meant, shape (d_i,).

    Returns
    -------
    ndarray of bool, shape (d,)
    """
    views = frame_views(posterior)
    found = [(view.to_frame[wanted(view.posterior)] != 0.0).any(axis=0) for view in views]
    return np.asarray(np.any(found, axis=0))


def are_scales(frame: Posterior) -> Flags:
    """Which of a frame's parameters set the errors of the others, shape (d_i,)."""
    return np.isin(frame.parameter_names, frame.hyperparameters)


@dataclass(frozen=True, eq=False)
class FrameFolds:
    """Which parts of the frames sources and pixels belong to.

    Attributes
    ----------
    frames : mapping of str to Folds
        By name, of a single frame an empty one.
    """

    frames: Mapping[str, Folds]

    @property
    def sources(self) -> Ints:
        """Fold of each source, those of all frames one after the other: see `Folds.sources`."""
        return np.concatenate([each.sources for each in self.frames.values()])

    @property
    def members(self) -> tuple[tuple[int | str, ...], ...]:
        """The sources of every fold: numbers from 0, of several frames texts such as `a.3`."""
        names = [
            f"{name}.{k}" if name else k
            for name, each in self.frames.items()
            for k in range(each.sources.size)
        ]
        sources = self.sources
        return tuple(
            tuple(names[j] for j in np.flatnonzero(sources == k))
            for k in range(int(sources.max()) + 1)
        )

    def without(self, posterior: AnyPosterior, fold: int) -> AnyPosterior:
        """The posterior without the pixels of a fold."""
        return self._masked(posterior, lambda folds, frame: folds.without(frame, fold))

    def only(self, posterior: AnyPosterior, fold: int) -> AnyPosterior:
        """The posterior of the pixels of one fold."""
        return self._masked(posterior, lambda folds, frame: folds.only(frame, fold))

    def _masked(
        self, posterior: AnyPosterior, masked: Callable[[Folds, Posterior], Posterior]
    ) -> AnyPosterior:
        if not isinstance(posterior, JointPosterior):
            return masked(self.frames[""], posterior)
        frames = {name: masked(self.frames[name], f) for name, f in posterior.frames.items()}
        return with_frames(posterior, frames)


def fold_frames(posterior: AnyPosterior, params: Floats, number: int) -> FrameFolds:
    """Deal the sources of one frame or several to folds, and give each fold its pixels.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
    params : ndarray, shape (d,)
        Where the images stand.
    number : int
        Folds; some are empty where there are fewer sources.

    Returns
    -------
    FrameFolds
    """
    dealt: dict[tuple[float, float], int] = {}
    total, frames = np.zeros(number, dtype=int), {}
    for view in frame_views(posterior):
        frame, own = view.posterior, view.to_frame @ params
        places, there = _places(frame.model.sources), visible(frame, own)
        before = [dealt[places[k]] for k in there if places[k] in dealt]
        known = dealt
        if len(set(before)) == 1 and len(before) == there.size > 1:
            known, before = {}, []  # all in one fold, which would be without the others
        counts = np.bincount(np.array(before, dtype=int), minlength=number)
        sources = np.full(len(places), -1)
        for k in there:
            if places[k] not in known:
                known[places[k]] = int(np.lexsort([total, counts])[0])
                counts[known[places[k]]] += 1
            sources[k] = known[places[k]]
        total += counts
        frames[view.name] = share_pixels(frame, own, sources)
    return FrameFolds(frames)


def require_visible(folds: FrameFolds, fewest: int, purpose: str) -> None:
    """Raise InputError if a frame shows too few sources.

    Parameters
    ----------
    folds : FrameFolds
    fewest : int
        Sources of each frame.
    purpose : str
        What for.

    Raises
    ------
    InputError
    """
    for name, each in folds.frames.items():
        number = int(np.sum(each.sources >= 0))
        if number < fewest:
            where, less = (f"frame {name}", ", or leave it out") if name else ("the frame", "")
            raise InputError(
                f"catalogue: got {number} sources with an image in {where}, expected at least "
                f"{fewest} {purpose}: check positions and mask{less}"
            )


def _places(sources: SourceCatalog) -> list[tuple[float, float]]:
    """What tells sources apart in any frame."""
    sky = sources.sky
    place = (sources.x, sources.y) if sky is None else sky.to_sky(sources.x, sources.y)
    one, two = np.round(place, DIGITS).tolist()
    return list(zip(one, two, strict=True))

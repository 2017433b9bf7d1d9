r"""The scatter of sources' positions, held at a value that makes a chi-square right.

The scatter tau sets the errors of positions. A chi-square of differences d with the variance tau^2
that is divided by an estimate t^2 has the mean E[tau^2 / t^2], so t is the root of one over the
mean of 1 / tau^2 under the posterior of tau, which is that of its nested Laplace approximation.

Of several frames each has its own. Its posterior is that of the frame, given what the other frames
and the prior say of the shared parameters: near the joint maximum m a paraboloid whose information
is the sum of the other frames' (`optimize.joint_map.schur_complements`), and whose slope there is
minus that of the frame, because m is a maximum. Where frames share the scatter, it is nested in the
posterior of all.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

from bayesfred._typing import Floats
from bayesfred.analysis.joint_folds import AnyPosterior
from bayesfred.model.joint import JointPosterior
from bayesfred.model.posterior import Posterior
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate, inverse
from bayesfred.optimize.joint_map import schur_complements
from bayesfred.sampling.moves import LaplaceMove

__all__ = ["hold_scatter"]

SCATTER = "position_scatter"
HELD = 1e-4  # relative standard deviation of a parameter that is held


def hold_scatter(posterior: AnyPosterior, whole: MapEstimate) -> tuple[AnyPosterior, Floats]:
    """Hold the scatter of positions where it is a parameter.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
    whole : MapEstimate
        Its maximum.

    Returns
    -------
    posterior : Posterior or JointPosterior
        With priors that hold it.
    params : ndarray, shape (d,)
        The maximum's, with that value.
    """
    if isinstance(posterior, JointPosterior):
        values = _of_frames(posterior, whole)
    else:
        values = {name: _value(posterior, whole) for name in posterior.hyperparameters}
    if not values:
        return posterior, whole.params
    start, held = whole.params.copy(), dict(posterior.prior)
    for name, value in values.items():
        start[posterior.parameter_names.index(name)] = value
        held[name] = stats.norm(value, HELD * value)
    if isinstance(posterior, JointPosterior):
        return replace(posterior, prior=held), start
    return replace(posterior, prior=held, extrapolation=None), start


def _value(density: TargetDensity, top: MapEstimate) -> float:
    """The value of the hyperparameter at which to hold it."""
    nested = LaplaceMove.of(density, top)
    k = density.parameter_names.index(density.hyperparameters[0])
    values = nested.means[:, int(np.argmax(nested.order == k))]
    return float((nested.weights @ values**-2.0) ** -0.5)


def _of_frames(joint: JointPosterior, whole: MapEstimate) -> dict[str, float]:
    """The values of the scatters of several frames by the parameters' names."""
    if SCATTER in joint.shared:
        nested = _SharedScatter(
            joint.frames, joint.shared, prior=joint.prior, drift=joint.drift,
            evaluator=joint.evaluator,
        )  # fmt: skip
        return {SCATTER: _value(nested, whole)}
    scattered = {name: f for name, f in joint.frames.items() if f.nuisances.position_scatter}
    if not scattered:
        return {}
    told = dict(zip(joint.frames, schur_complements(joint, whole.params), strict=True))
    every = sum(told.values(), np.diag(joint.prior_curvature(whole.params)[: joint.n_shared]))
    values = {}
    for name in scattered:
        given = _GivenOthers.of(joint, name, whole.params, every - told[name])
        covariance = joint.frame_covariance(name, whole.covariance)
        top = MapEstimate(given.top, covariance, float(given.log_prob(given.top)), 0, "")
        values[f"{name}.{SCATTER}"] = _value(given, top)
    return values


class _SharedScatter(JointPosterior):
    """Frames that share their scatter, which makes it a hyperparameter of all."""

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        return (SCATTER,)


@dataclass(frozen=True, eq=False)
class _GivenOthers(TargetDensity):
    """The posterior of a frame given what the other frames say of the shared parameters.

    Its log-density is that of the frame plus `pull` x - x `more` x / 2, x from the joint maximum.
    """

    frame: Posterior
    top: Floats  # (d_i,) the joint maximum
    pull: Floats  # (d_i,)
    more: Floats  # (d_i, d_i)

    @classmethod
    def of(cls, joint: JointPosterior, name: str, params: Floats, others: Floats) -> "_GivenOthers":
        """With the information of the others about the shared parameters, the prior included."""
        frame, top = joint.frame(name), joint.frame_params(name, params)
        matrix = joint.part_of(name).matrix
        moved = np.flatnonzero(matrix.any(axis=1))
        pull, more = np.zeros(top.size), np.zeros((top.size, top.size))
        pull[moved] = -frame.gradient(top)[moved]
        more[np.ix_(moved, moved)] = inverse(matrix[moved] @ inverse(others) @ matrix[moved].T)
        more[moved, moved] -= np.diag(frame.prior_information(top))[moved]  # which the frame has
        return cls(frame, top, pull, more)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return self.frame.parameter_names

    @property
    def support(self) -> tuple[Floats, Floats]:
        return self.frame.support

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        return self.frame.hyperparameters

    def log_prob(self, params: npt.ArrayLike) -> Any:
        x = np.asarray(params, dtype=np.float64) - self.top
        return (
            self.frame.log_prob(params) + x @ self.pull - 0.5 * np.sum(x @ self.more * x, axis=-1)
        )

    def gradient(self, params: npt.ArrayLike) -> Floats:
        x = np.asarray(params, dtype=np.float64) - self.top
        return self.frame.gradient(params) + self.pull - self.more @ x

    def information(self, params: npt.ArrayLike) -> Floats:
        return self.frame.information(params) + self.more

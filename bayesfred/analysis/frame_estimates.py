r"""What each of several frames alone says of the parameters that all share.

At the joint maximum frame i has the gradient g_i and the Fisher information I_i. With c its shared
and o its own parameters, the prior of the latter in both, eliminating o leaves

    S_i = I_cc - I_co I_oo^-1 I_oc,      s_i = g_c - I_co I_oo^-1 g_o,

so that the frame alone, without a prior of what is shared, has its maximum S_i^-1 s_i away, with
the covariance S_i^-1: a Newton step, exact where the likelihood is normal.
`frame_agreement` asks whether the frames agree; here are the numbers that a reader can compare.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from bayesfred._typing import Floats
from bayesfred.model.joint import JointPosterior
from bayesfred.optimize.estimate import inverse
from bayesfred.sampling.chain import Chain

__all__ = ["FrameEstimates", "frame_estimates"]


class FrameEstimates(NamedTuple):
    """What every frame alone says of the parameters that all share, and what all say together.

    Attributes
    ----------
    names : tuple of str, length k
        Of the frames.
    times : ndarray, shape (k,), or None
        When they were taken, if shared parameters drift.
    values, sd : ndarray, shape (k, p), parameter units
        Of each frame alone; nan where it does not determine them all.
    joint, joint_sd : ndarray, shape (k, p), parameter units
        Of all together, at each frame; without a drift the same at all.
    """

    names: tuple[str, ...]
    times: Floats | None
    values: Floats
    sd: Floats
    joint: Floats
    joint_sd: Floats

    @property
    def pulls(self) -> Floats:
        """By how many standard deviations each frame alone is off all together, shape (k, p).

        A frame is one of all: the variance of the difference is its own less that of all.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            pulls = (self.values - self.joint) / np.sqrt(self.sd**2 - self.joint_sd**2)
        return np.nan_to_num(pulls, posinf=0.0, neginf=0.0)

    @property
    def message(self) -> str:
        """One line: how much better the frames together know what they share."""
        together, alone = np.median(self.joint_sd, axis=0), np.fmin.reduce(self.sd, axis=0)
        gain = (together / alone)[np.isfinite(alone)]
        what = f"{len(self.names)} frames share {self.sd.shape[1]} parameters"
        if not gain.size:
            return f"{what}, which no frame alone determines."
        return (
            f"{what}: their errors are {np.median(gain):.2f} times those of the best single frame "
            f"({gain.min():.2f} to {gain.max():.2f})."
        )


def frame_estimates(chain: Chain) -> FrameEstimates:
    """Estimate the shared parameters from each frame alone.

    Parameters
    ----------
    chain : Chain
        Of a `JointPosterior`.

    Returns
    -------
    FrameEstimates

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> joint = bf.JointPosterior({
    ...     name: bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=k))
    ...     for k, name in enumerate("abcd")})
    >>> found = frame_estimates(bf.laplace(joint, seed=1, progress=False))
    >>> print(found.message)  # four frames halve the error of one
    4 frames share 1 parameters: their errors are 0.5... times those of the best single frame ...
    """
    joint: JointPosterior = chain.posterior()
    params, draws = chain.estimate.params, chain.draws()
    derivatives = joint.derivatives(params)
    slope, curvature = joint.prior_gradient(params), joint.prior_curvature(params)
    rows = []
    for (name, frame), part, (gradient, fisher) in zip(
        joint.frames.items(), joint.parts, derivatives, strict=True
    ):
        common = np.flatnonzero(part.columns < len(joint.shared))
        common = common[np.argsort(part.columns[common])]
        score, told = gradient[common], fisher[np.ix_(common, common)]
        if part.own.size:
            own = fisher[np.ix_(part.places, part.places)] + np.diag(curvature[part.own])
            cross = fisher[np.ix_(common, part.places)] @ inverse(own)
            score = score - cross @ (gradient[part.places] + slope[part.own])
            told = told - cross @ fisher[np.ix_(part.places, common)]
        step, covariance = _newton(score, told)
        if frame.added_covariance is not None:
            covariance = covariance + frame.added_covariance[np.ix_(common, common)]
        here = joint.frame_params(name, params)[common]
        spread = joint.frame_params(name, draws)[:, common].std(axis=0, ddof=1)
        rows.append((here + step, np.sqrt(np.diag(covariance)), here, spread))
    drift = joint.drift
    times = None if drift is None else np.array([drift.times[name] for name in joint.frames])
    return FrameEstimates(
        tuple(joint.frames), times, *(np.array(column) for column in zip(*rows, strict=True))
    )


def _newton(score: Floats, told: Floats) -> tuple[Floats, Floats]:
    """The step to a frame's own maximum and its covariance; nan where it has none."""
    try:
        linalg.cholesky(told)
        covariance = inverse(told)
    except (linalg.LinAlgError, ValueError):
        return np.full_like(score, np.nan), np.full_like(told, np.nan)
    return covariance @ score, covariance

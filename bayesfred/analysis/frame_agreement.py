r"""Whether several frames agree about what they share, and which one does not.

At the joint maximum m frame i has the score s_i of the shared parameters phi and the information
S_i about them, its own parameters eliminated. Near m its log-likelihood is a paraboloid,

    b_i phi - phi^T S_i phi / 2,        b_i = s_i + S_i m,

and so is the prior, with P in the place of S_i. Frames i of any set have the maximum V b, with b =
sum b_i and V = (sum S_i)^-1, the prior among them. There frame i has the score t_i = b_i - S_i V b.
If all share one phi, S_i is the covariance of b_i and

    Cov t_i = S_i - S_i V S_i + sum_j M_j G_j M_j^T,        M_j = delta_ij - S_i V,

G_j what the errors of frame j's PSF add. t_i^T (Cov t_i)^-1 t_i is a chi-square with as many
degrees of freedom as there are directions of which frame i tells something and the others too.

The frame with the least probability is left out while it is below `CHANCE` over the number of
frames, and the others are asked again without it: a frame of another instrument pulls the shared
parameters, so that at first all disagree.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg, stats

from bayesfred._typing import Floats
from bayesfred.model.joint import JointPosterior
from bayesfred.optimize.estimate import inverse
from bayesfred.optimize.joint_map import schur_complements

__all__ = ["FrameAgreement", "frame_agreement"]

CHANCE = 0.01  # probability that frames of one instrument are said to disagree
TOLD = 1e-3  # share of what is known of a direction that the frame, and the others, tell at least
MOST_NAMED = 5


@dataclass(frozen=True, eq=False)
class FrameAgreement:
    """How well frames agree about the parameters that they share.

    Attributes
    ----------
    names : tuple of str, length k
        Of the frames.
    p : ndarray, shape (k,)
        Probability that a frame differs as much from those that agree if it shares what it should;
        nan where it tells nothing that others tell.
    odd : tuple of str
        Frames that differ from the others.
    """

    names: tuple[str, ...]
    p: Floats
    odd: tuple[str, ...]

    @property
    def agree(self) -> bool:
        """Whether all frames share what they should."""
        return not self.odd

    @property
    def message(self) -> str:
        """One sentence."""
        if self.agree:
            least = f" (least p = {np.nanmin(self.p):.2g})" if np.isfinite(self.p).any() else ""
            return f"The frames agree about what they share{least}."
        named = ", ".join(self.odd[:MOST_NAMED])
        more = len(self.odd) - MOST_NAMED
        named += f" and {more} more" if more > 0 else ""
        if 2 * len(self.odd) >= len(self.names):
            return (
                f"The frames disagree about what they share ({named} differ from the others): "
                "share less, or fit them apart."
            )
        one = len(self.odd) == 1
        worst = min(self.p[self.names.index(name)] for name in self.odd)
        return (
            f"{'Frame' if one else 'Frames'} {named} {'does' if one else 'do'} not share what the "
            f"others share (p = {worst:.1g}): another instrument or setting, or a wrong catalogue; "
            f"leave {'it' if one else 'them'} out."
        )


def frame_agreement(joint: JointPosterior, params: Floats) -> FrameAgreement:
    """Ask every frame whether it shares what the others share.

    Parameters
    ----------
    joint : JointPosterior
    params : ndarray, shape (d,)
        Its maximum.

    Returns
    -------
    FrameAgreement

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> frames = {
    ...     name: bf.Posterior(model, bf.simulate(model, [theta], 2.0, seed=k))
    ...     for k, (name, theta) in enumerate({"a": 1e-4, "b": 1e-4, "c": 9e-4, "d": 1e-4}.items())}
    >>> joint = bf.JointPosterior(frames)
    >>> frame_agreement(joint, bf.find_map(joint).params).odd
    ('c',)
    """
    p, names = joint.n_shared, tuple(joint.frames)
    prior = np.diag(joint.prior_curvature(params)[:p])
    told = schur_complements(joint, params)
    scale = 1.0 / np.sqrt(np.diag(sum(told, prior)))
    told = [each * np.outer(scale, scale) for each in told]
    prior = prior * np.outer(scale, scale)
    centre, slope = params[:p] / scale, joint.prior_gradient(params)
    curvature = joint.prior_curvature(params)
    pulls, excess = [], []
    for k, (name, part, (gradient, fisher)) in enumerate(
        zip(names, joint.parts, joint.derivatives(params), strict=True)
    ):
        score = part.matrix.T @ gradient
        if part.own.size:
            own = fisher[np.ix_(part.places, part.places)] + np.diag(curvature[part.own])
            cross = part.matrix.T @ fisher[:, part.places]
            score -= cross @ inverse(own) @ (gradient[part.places] + slope[part.own])
        pulls.append(score * scale + told[k] @ centre)
        excess.append(_psf_excess(joint, name, told[k], scale))
    of_prior = prior, slope[:p] * scale + prior @ centre
    frames = _Paraboloids(told, pulls, excess, of_prior)
    inside, odd = list(range(len(names))), list[int]()
    while True:
        found = {i: frames.chance(i, inside) for i in inside}
        tested = {i: chance for i, chance in found.items() if np.isfinite(chance)}
        worst = min(tested, key=lambda i: tested[i], default=-1)
        if worst < 0 or tested[worst] >= CHANCE / len(names) or len(inside) < 2:
            break
        inside.remove(worst)
        odd.append(worst)
    every = np.array([frames.chance(i, sorted({*inside, i})) for i in range(len(names))])
    return FrameAgreement(names, every, tuple(names[i] for i in sorted(odd)))


def _psf_excess(joint: JointPosterior, name: str, told: Floats, scale: Floats) -> Floats | None:
    """What the errors of a frame's PSF add to the covariance of its score."""
    errors = joint.frames[name].psf_errors
    if errors is None:
        return None
    moved = np.flatnonzero(joint.part_of(name).matrix.any(axis=1))
    back = np.linalg.pinv(joint.part_of(name).matrix[moved])
    covariance = back @ errors.covariance[np.ix_(moved, moved)] @ back.T
    return np.asarray(told @ (covariance / np.outer(scale, scale)) @ told)


class _Paraboloids(NamedTuple):
    """The log-likelihoods of all frames, and the prior, about what is shared, in scaled units."""

    told: list[Floats]  # S_i
    pulls: list[Floats]  # b_i
    excess: list[Floats | None]  # G_i
    prior: tuple[Floats, Floats]  # its S and b

    def chance(self, i: int, inside: Sequence[int]) -> float:
        """The probability of frame i's score among the frames `inside`; nan if it tells nothing."""
        total = sum((self.told[j] for j in inside), self.prior[0])
        covariance, told = linalg.inv(total), self.told[i]
        maximum = covariance @ sum((self.pulls[j] for j in inside), self.prior[1])
        # the directions in which this frame knows the share a of what is known
        share, axes = linalg.eigh(told, total)
        usable = (share > TOLD) & (share < 1.0 - TOLD)
        if not usable.any():
            return np.nan
        through, axes = told @ covariance, axes[:, usable]
        spread = told - through @ told
        for j in inside:
            more = self.excess[j]
            if more is not None:
                change = float(i == j) * np.eye(len(told)) - through
                spread = spread + change @ more @ change.T
        lower = linalg.cholesky(axes.T @ spread @ axes, lower=True)
        score = axes.T @ (self.pulls[i] - told @ maximum)
        chi2 = float(np.sum(linalg.solve_triangular(lower, score, lower=True) ** 2))
        return float(stats.chi2.sf(chi2, usable.sum()))

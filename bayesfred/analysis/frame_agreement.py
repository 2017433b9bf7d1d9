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

Where positions scatter, or a model is in error, S_i depends on scales that few sources tell: of 30
sources whose positions scatter it is known to a third or less. Frames that would disagree are asked
again with scales from a grid, each with the probability that its likelihood and prior give it, once
what else is unknown is integrated out in the approximation. Of a normal mean with an unknown
variance that is Student's test.

The frame with the least probability is left out while it is below `CHANCE` over the number of
frames, and the others are asked again without it: a frame of another instrument pulls the shared
parameters, so that at first all disagree.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import linalg, stats

from bayesfred._typing import Flags, Floats
from bayesfred.model.joint import JointPosterior
from bayesfred.model.parameters import SCALES
from bayesfred.optimize.estimate import inverse

__all__ = ["FrameAgreement", "frame_agreement"]

CHANCE = 0.01  # probability that frames of one instrument are said to disagree
TOLD = 1e-3  # share of what is known of a direction that the frame, and the others, tell at least
MOST_NAMED = 5
NODES = np.linspace(-1.6, 1.6, 5)  # of the grid, about a scale's logarithm
DRAWS = 64


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
    scales = joint.scales
    agreement = _agreement(joint, [_paraboloids(joint, params, ~scales)])
    if agreement.agree or not scales.any():
        return agreement
    return _agreement(joint, _of_scales(joint, params, scales))


def _agreement(joint: JointPosterior, several: "Sequence[_Paraboloids]") -> FrameAgreement:
    """From probabilities that are averaged over approximations of the likelihood."""
    names = tuple(joint.frames)

    def chance(i: int, inside: Sequence[int]) -> float:
        return float(np.mean([frames.chance(i, inside) for frames in several]))

    inside, odd = list(range(len(names))), list[int]()
    while True:
        found = {i: chance(i, inside) for i in inside}
        tested = {i: each for i, each in found.items() if np.isfinite(each)}
        worst = min(tested, key=lambda i: tested[i], default=-1)
        if worst < 0 or tested[worst] >= CHANCE / len(names) or len(inside) < 2:
            break
        inside.remove(worst)
        odd.append(worst)
    every = np.array([chance(i, sorted({*inside, i})) for i in range(len(names))])
    return FrameAgreement(names, every, tuple(names[i] for i in sorted(odd)))


def _of_scales(joint: JointPosterior, params: Floats, scales: Flags) -> "list[_Paraboloids]":
    """Approximations whose scales are drawn, frame by frame, from their posterior on a grid."""
    kinds = [
        scales & np.array([name.endswith(kind) for name in joint.parameter_names])
        for kind in SCALES
    ]
    kinds = [kind for kind in kinds if kind.any()]
    logarithms = np.array(list(product(NODES, repeat=len(kinds))))
    vectors = params * np.exp(logarithms @ np.array(kinds, float))
    at_nodes = [_paraboloids(joint, vector, ~scales) for vector in vectors]
    middle = at_nodes[len(at_nodes) // 2]
    total = sum(middle.told, middle.prior[0])
    random, drawn = np.random.default_rng(0), []
    for i, parts in enumerate(joint.log_parts(vectors)[:-1]):
        volume = [
            np.linalg.slogdet(total - middle.told[i] + node.told[i])[1] + node.own[i]
            for node in at_nodes
        ]
        weight = parts + logarithms.sum(axis=1) - 0.5 * np.array(volume)
        weight = np.exp(weight - weight.max())
        drawn.append(random.choice(len(weight), DRAWS, p=weight / weight.sum()))
    return [
        middle._replace(
            told=[at_nodes[k].told[i] for i, k in enumerate(nodes)],
            pulls=[at_nodes[k].pulls[i] for i, k in enumerate(nodes)],
            excess=[at_nodes[k].excess[i] for i, k in enumerate(nodes)],
        )
        for nodes in np.transpose(drawn)
    ]


def _paraboloids(joint: JointPosterior, params: Floats, free: Flags) -> "_Paraboloids":
    """The approximations at some parameters, of which those that are `free` are eliminated."""
    p, curvature, slope = (
        joint.n_shared, joint.prior_curvature(params), joint.prior_gradient(params)
    )  # fmt: skip
    told, pulls, excess, volumes = [], [], [], []
    for name, part, (gradient, fisher) in zip(
        joint.frames, joint.parts, joint.derivatives(params), strict=True
    ):
        places, columns = part.places[free[part.own]], part.own[free[part.own]]
        through = part.matrix.T @ fisher
        own = fisher[np.ix_(places, places)] + np.diag(curvature[columns])
        gain = through[:, places] @ inverse(own) if places.size else through[:, places]
        shared = through @ part.matrix - gain @ through[:, places].T
        score = part.matrix.T @ gradient - gain @ (gradient[places] + slope[columns])
        told.append(0.5 * (shared + shared.T))
        pulls.append(score + told[-1] @ params[:p])
        excess.append(_added(joint, name, told[-1]))
        volumes.append(float(np.linalg.slogdet(own)[1]))
    prior = np.diag(curvature[:p])
    pull = slope[:p] + prior @ params[:p]
    return _Paraboloids(told, pulls, excess, (prior, pull), volumes)


def _added(joint: JointPosterior, name: str, told: Floats) -> Floats | None:
    """What errors that a frame's likelihood has not add to the covariance of its score."""
    added = joint.frames[name].added_covariance
    if added is None:
        return None
    moved = np.flatnonzero(joint.part_of(name).matrix.any(axis=1))
    back = np.linalg.pinv(joint.part_of(name).matrix[moved])
    covariance = back @ added[np.ix_(moved, moved)] @ back.T
    return np.asarray(told @ covariance @ told)


class _Paraboloids(NamedTuple):
    """The log-likelihoods of all frames, and the prior, about what is shared."""

    told: list[Floats]  # S_i
    pulls: list[Floats]  # b_i
    excess: list[Floats | None]  # G_i
    prior: tuple[Floats, Floats]  # its S and b
    own: list[float]  # logarithms of the determinants of what is eliminated

    def chance(self, i: int, inside: Sequence[int]) -> float:
        """The probability of frame i's score among the frames `inside`; nan if it tells nothing."""
        total = sum((self.told[j] for j in inside), self.prior[0])
        unit = 1.0 / np.sqrt(np.diag(total))  # of what is shared
        units = np.outer(unit, unit)
        total, told = total * units, self.told[i] * units
        covariance = linalg.inv(total)
        maximum = covariance @ (unit * sum((self.pulls[j] for j in inside), self.prior[1]))
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
                spread = spread + change @ (more * units) @ change.T
        lower = linalg.cholesky(axes.T @ spread @ axes, lower=True)
        score = axes.T @ (unit * self.pulls[i] - told @ maximum)
        chi2 = float(np.sum(linalg.solve_triangular(lower, score, lower=True) ** 2))
        return float(stats.chi2.sf(chi2, usable.sum()))

r"""The maximum of several frames' joint posterior.

Every frame has a start of its own (`starts`) and there a paraboloid of its own: with gradient g_i
and Fisher information I_i at its start s_i, log L_i is to second order

    g_i (t_i - s_i) - (t_i - s_i)^T I_i (t_i - s_i) / 2,        t_i = A_i (phi, nu_i).

Their sum with the prior has one maximum, at which the search begins: a Newton step of all frames
together, each from where it stands. The search itself is that of `newton`, whose steps go in the
joint information.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import linalg, stats

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.psf import MeasuredPSF
from bayesfred.model.joint import JointPosterior
from bayesfred.model.posterior import Posterior
from bayesfred.model.psf_errors import PsfErrors, covariance_of, refuse_nodes
from bayesfred.optimize.determined import require_light, undetermined
from bayesfred.optimize.estimate import inverse
from bayesfred.optimize.modes import find_modes
from bayesfred.optimize.newton import NO_DENSITY, NewtonResult, maximize
from bayesfred.optimize.outliers import Kept
from bayesfred.optimize.starts import find_start

CLOSENESS = 1e-3  # standard deviations from the maximum at which one is found
STEPS = 8  # of Newton's method for a frame alone, where frames together lead nowhere

Rejecting = Callable[[Posterior, Floats], tuple[Kept, Floats, int]]


class JointMaximum(NamedTuple):
    """Where a search for the maximum of several frames ended.

    Attributes
    ----------
    posterior : JointPosterior
        Of what is kept.
    kept : mapping of str to Kept
    top : NewtonResult
    evaluations : int
        Of all frames.
    several : tuple of str
        Frames that may have other modes.
    """

    posterior: JointPosterior
    kept: Mapping[str, Kept]
    top: NewtonResult
    evaluations: int
    several: tuple[str, ...]


def maximize_frames(
    joint: JointPosterior, rejecting: Rejecting, start: Sequence[float] | Floats | None
) -> JointMaximum:
    """Find the maximum of the joint posterior of what is kept of every frame.

    Parameters
    ----------
    joint : JointPosterior
    rejecting : callable
        `keep_all` or `reject`, of `outliers`.
    start : array_like, shape (d,), optional
        Where to begin.

    Returns
    -------
    JointMaximum

    Raises
    ------
    InputError
        If a frame holds no information, the start has no density, or the frames cannot determine
        some parameters.
    """
    kept, origins, spent = {}, [], 0
    begin = None if start is None else np.array(start, dtype=np.float64)
    for name, frame in joint.frames.items():
        try:
            require_light(frame)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
        begun = find_start(frame).params if begin is None else joint.frame_params(name, begin)
        kept[name], origin, more = rejecting(frame, begun)
        origins.append(origin)
        spent = max(spent, more)
    if any(kept[name].posterior is not frame for name, frame in joint.frames.items()):
        joint = with_frames(joint, {name: each.posterior for name, each in kept.items()})
    params = _combined(joint, origins) if begin is None else begin
    if not np.isfinite(joint.log_prob(params)):
        raise InputError(NO_DENSITY)
    _require_determined(joint, params)
    top = maximize(joint, params)
    evaluations = spent + top.evaluations + 1
    if not top.distance < CLOSENESS and begin is None:
        steps = [
            maximize(frame, origin, steps=STEPS)
            for frame, origin in zip(joint.frames.values(), origins, strict=True)
        ]
        params = _combined(joint, [each.params for each in steps])
        if np.isfinite(joint.log_prob(params)):
            again = maximize(joint, params)
            evaluations += STEPS + again.evaluations
            top = again if again.distance < CLOSENESS else top
    several = tuple(name for name in joint.frames if _has_others(joint, name, top))
    return JointMaximum(joint, kept, top, evaluations, several)


def with_frames(joint: JointPosterior, frames: Mapping[str, Posterior]) -> JointPosterior:
    """The same joint posterior of other frames, evaluated in this process."""
    prior, drift = joint.prior, joint.drift
    return JointPosterior(frames, joint.shared, prior=prior, drift=drift)


def marginalize_joint_psf(joint: JointPosterior, params: Floats) -> JointPosterior:
    """Let the errors of the frames' measured PSFs widen those of the parameters.

    Frames that have one PSF in common err together, others independently.

    Parameters
    ----------
    joint : JointPosterior
    params : ndarray, shape (d,)
        Its maximum.

    Returns
    -------
    JointPosterior
        With `psf_errors` where a frame has a PSF with errors.
    """
    psfs: dict[int, list[MeasuredPSF]] = {}
    for frame in joint.frames.values():
        psf = frame.model.psf
        if isinstance(psf, MeasuredPSF) and psf.draws is not None:
            refuse_nodes(psf)
            psfs.setdefault(id(psf), list(psf.drawn()))
    if not psfs:
        return joint
    n = min(len(drawn) for drawn in psfs.values())
    slopes, random = np.zeros((n, joint.n_parameters)), np.random.default_rng(0)
    order = {key: random.permutation(len(drawn))[:n] for key, drawn in psfs.items()}
    absorbed = 0.0
    for (name, frame), part in zip(joint.frames.items(), joint.parts, strict=True):
        key, likelihood = id(frame.model.psf), frame.likelihood
        if key not in psfs:
            continue
        absorbed += frame.psf_errors.absorbed if frame.psf_errors else 0.0
        centre = joint.frame_params(name, params)
        for row, k in zip(slopes, order[key], strict=True):
            model = replace(likelihood.model, psf=psfs[key][k])
            drawn = replace(likelihood, model=model)
            drawn.share_frame(likelihood)
            slope = drawn.gradient(centre)
            row[: joint.n_shared] += part.matrix.T @ slope
            row[part.own] += slope[part.places]
    information, covariance = joint.information(params), covariance_of(slopes)
    errors = PsfErrors.of(joint.parameter_names, information, covariance, absorbed)
    return replace(joint, psf_errors=errors)


def _combined(joint: JointPosterior, origins: Sequence[Floats]) -> Floats:
    """The maximum of the sum of the frames' paraboloids, each about a start of its own."""
    derivatives = joint.evaluator.derivatives(origins)
    plain, weights = joint.start(), np.zeros(joint.n_shared)
    plain[: len(joint.shared)] = 0.0
    for part, origin in zip(joint.parts, origins, strict=True):
        shared = np.flatnonzero(part.columns < len(joint.shared))
        plain[part.columns[shared]] += origin[shared] / len(origins)
        plain[part.own] = origin[part.places]
    low, high = joint.support
    plain = np.clip(plain, low, high)
    curvature = joint.prior_curvature(plain)
    slope = joint.prior_gradient(plain)
    total = np.where(np.isfinite(slope), slope, 0.0)
    information = joint.assembled([fisher for _, fisher in derivatives]) + np.diag(curvature)
    for name, part, origin, (gradient, fisher) in zip(
        joint.frames, joint.parts, origins, derivatives, strict=True
    ):
        pull = gradient + fisher @ (origin - joint.frame_params(name, plain))
        total[: weights.size] += part.matrix.T @ pull
        total[part.own] += pull[part.places]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 1.0 / np.sqrt(np.diag(information))
    scaled = information * np.outer(scale, scale)
    if not np.isfinite(scaled).all():
        return plain
    try:
        step = scale * linalg.solve(scaled, scale * total, assume_a="pos")
    except linalg.LinAlgError:
        return plain
    params = np.clip(plain + step, low, high)
    return params if np.isfinite(joint.log_prob(params)) else plain


def schur_complements(joint: JointPosterior, params: Floats) -> list[Floats]:
    """What every frame says of the shared parameters, its own ones eliminated: (p, p) each.

    The prior of the frame's own parameters counts as known.
    """
    curvature = joint.prior_curvature(params)
    found = []
    for part, (_, fisher) in zip(joint.parts, joint.derivatives(params), strict=True):
        through = part.matrix.T @ fisher
        shared, cross = through @ part.matrix, through[:, part.places]
        if part.own.size:
            own = fisher[np.ix_(part.places, part.places)] + np.diag(curvature[part.own])
            shared = shared - cross @ inverse(own) @ cross.T
        found.append(0.5 * (shared + shared.T))
    return found


def _require_determined(joint: JointPosterior, params: Floats) -> None:
    """Refuse parameters about which neither frames nor priors say anything.

    A frame is asked about its parameters with what the other frames say of the shared ones.
    """
    told = schur_complements(joint, params)
    prior = np.diag(joint.prior_curvature(params)[: joint.n_shared])
    names = []
    for name, part, own, (_, fisher) in zip(
        joint.frames, joint.parts, told, joint.derivatives(params), strict=True
    ):
        moved = np.flatnonzero(part.matrix.any(axis=1))
        by_others = part.matrix[moved] @ inverse(sum(told, prior) - own) @ part.matrix[moved].T
        more = fisher.copy()
        frame = joint.frames[name]
        sd = np.array([frame.parameters[k].prior.std() for k in moved])
        known = inverse(by_others) - np.diag(sd**-2.0)
        more[np.ix_(moved, moved)] += known
        weak = undetermined(frame, joint.frame_params(name, params), more)
        names += [each if each in joint.shared else f"{name}.{each}" for each in weak]
    if names:
        raise InputError(
            f"parameters: the frames cannot determine {', '.join(dict.fromkeys(names))}, expected "
            "each to move the counts by more than their noise: leave out terms, add sources, or "
            "give these parameters a narrower prior"
        )


def _has_others(joint: JointPosterior, name: str, top: NewtonResult) -> bool:
    """Whether a frame has other modes while the shared parameters are as well known as they are."""
    if not np.isfinite(top.distance):
        return False
    frame, params = joint.frames[name], joint.frame_params(name, top.params)
    covariance = joint.frame_covariance(name, top.covariance)
    part, known = joint.part_of(name), dict(frame.prior)
    for k in np.flatnonzero(part.matrix.any(axis=1)):
        known[frame.parameter_names[k]] = stats.norm(params[k], np.sqrt(covariance[k, k]))
    given = replace(frame, prior=known)
    log_prob = float(given.log_prob(params))
    alone = NewtonResult(params, log_prob, covariance, 0.0, 0)
    return find_modes(given, alone).modes is not None

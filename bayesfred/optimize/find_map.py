"""The posterior's maximum: `starts` says where to begin, `newton` maximises, here it is judged.

`modes` looks for others beside the one that is found.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.joint import JointPosterior
from bayesfred.model.posterior import Posterior
from bayesfred.model.protocol import TargetDensity
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.determined import determined_degree, require_light, undetermined
from bayesfred.optimize.estimate import MapEstimate, Modes
from bayesfred.optimize.fit_statistics import consistent, fit_statistics, misfit
from bayesfred.optimize.joint_map import maximize_frames
from bayesfred.optimize.matched import enough_matched, source_light
from bayesfred.optimize.modes import ModeSearch, find_modes
from bayesfred.optimize.newton import NEAR, NO_DENSITY, NewtonResult, maximize
from bayesfred.optimize.outliers import BREAKDOWN, COARSE, SOME, Kept, keep_all, reject
from bayesfred.optimize.starts import Start, find_start, other_starts

# The maximum is found where a Newton step from it would move no parameter by more than this share
# of its error.
CLOSENESS = 1e-3

Frames = TypeVar("Frames", Posterior, JointPosterior)

MOST_NAMED = 3  # frames
MATCHED = 0.5  # of the sources; of fewer the search rather than the terms is to blame
STEPS = 8  # of Newton's method where the maximum itself is not wanted

# What the message of a search suggests that has not rejected them.
OUTLIERS = ", unmatched sources or spurious detections (reject_outliers leaves them out)"

MOSTLY_REJECTED = (
    "but over 40 % of the sources in the frame were rejected, so that what remains may fit with "
    "wrong parameters: check the catalogue, or narrow the priors"
)


def find_map(
    posterior: TargetDensity, start: Sequence[float] | Floats | None = None
) -> MapEstimate:
    """Maximise the posterior.

    Where a frame may have several modes all are looked for, wherever the search begins; the highest
    is the maximum.

    Parameters
    ----------
    posterior : Posterior, JointPosterior, or another TargetDensity with a start
    start : array_like, shape (d,), optional
        Where to begin; by default what the counts alone say: peaks matched to the catalogue, and
        other starts where no maximum is found from there, see `starts`.

    Returns
    -------
    MapEstimate

    Raises
    ------
    InputError
        If the frame holds no information; if the start has no posterior density, or the frame
        cannot determine some parameters, which are named; if there is no start where no frame
        could give one.

    References
    ----------
    J. Nocedal & S. Wright, Numerical Optimization, 2nd ed., chapter 4.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> find_map(posterior).fits_data
    True
    """
    if isinstance(posterior, Posterior):
        return _search(keep_all, posterior, start)[1]
    if isinstance(posterior, JointPosterior):
        return _search_frames(keep_all, posterior, start)[1]
    if start is None:
        raise InputError("start: got none, expected one for a density that is not of a frame")
    begin = np.array(start, dtype=np.float64)
    if not np.isfinite(posterior.log_prob(begin)):
        raise InputError(NO_DENSITY)
    top = maximize(posterior, begin)
    return _estimate(posterior, top, top.evaluations, "")


def reject_outliers(
    posterior: Frames, start: Sequence[float] | Floats | None = None
) -> tuple[Frames, MapEstimate]:
    """Maximise the posterior without unmatched sources and spurious detections.

    Sources that are missing from the frame are taken off the catalogue; detections of no source,
    and whatever else exceeds the noise by 5 standard deviations at the maximum, are masked. Where
    there is nothing to reject, the posterior is the one that was given.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
    start : array_like, shape (d,), optional
        Where to begin; as in `find_map`.

    Returns
    -------
    posterior : Posterior or JointPosterior
        The one to sample, of the sources and the pixels that remain.
    estimate : MapEstimate
        Its maximum; the message counts the rejected sources and pixels.

    Raises
    ------
    InputError
        As `find_map` does.

    Notes
    -----
    The counts choose what is rejected, and it is then taken for certain. Of a frame with nothing
    but noise 5 standard deviations reject one position in millions. Where more than seven in ten
    sources would have to go, the model is taken to be wrong, not the catalogue: then only what
    exceeds a share of the light of the stars nearby is rejected, or nothing.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> counts = bf.simulate(model, [1e-4], 2.0, seed=1)
    >>> counts[40:43, 20:23] += 500.0  # in no catalogue
    >>> posterior = bf.Posterior(model, counts)
    >>> find_map(posterior).fits_data
    False
    >>> kept, estimate = reject_outliers(posterior)
    >>> estimate.fits_data, bool(kept.mask[41, 21]), len(kept.model.sources)
    (True, False, 9)
    """
    if isinstance(posterior, JointPosterior):
        return _search_frames(reject, posterior, start)
    return _search(reject, posterior, start)


def approach(
    posterior: Posterior, start: Floats | None = None, *, rejecting: bool = False
) -> tuple[Posterior, MapEstimate]:
    """Go near the maximum of a posterior whose PSF has yet to be measured.

    With a PSF that is not the frame's the maximum is slow to reach, and of little use.

    Parameters
    ----------
    posterior : Posterior
    start : ndarray, shape (d,), optional
        Where to begin; by default what the counts alone say.
    rejecting : bool
        Leave out outliers, as `reject_outliers` does, but for what another PSF may leave of stars.

    Returns
    -------
    posterior : Posterior
        Of what is kept.
    estimate : MapEstimate
        After a few of Newton's steps.

    Raises
    ------
    InputError
        If the start has no posterior density, or the frame cannot determine some parameters.
    """
    require_light(posterior)
    with one_blas_thread():
        begun = next(_starts(posterior, start))
        params = begun.params
        if not np.isfinite(posterior.log_prob(params)):
            raise InputError(NO_DENSITY)
        _require_determined(posterior, begun, posterior.fisher(params))
        kept = keep_all(posterior, params)[0]
        if rejecting:  # a PSF that is not the frame's leaves a share of all light
            kept, params, _ = reject(posterior, params, COARSE, SOME)
        top = maximize(kept.posterior, params, steps=STEPS)
        return kept.posterior, _estimate(kept.posterior, top, top.evaluations, "")


def _search(
    rejecting: Callable[[Posterior, Floats], tuple[Kept, Floats, int]],
    posterior: Posterior,
    start: Sequence[float] | Floats | None,
) -> tuple[Posterior, MapEstimate]:
    """The posterior of what is kept, and its maximum."""
    require_light(posterior)
    # idle BLAS threads spin, and take the cores from what is at work
    with one_blas_thread():
        top, evaluations = None, 0
        for begun in _starts(posterior, start):
            if not np.isfinite(posterior.log_prob(begun.params)):
                if top is not None:
                    continue
                raise InputError(NO_DENSITY)
            information = None
            if top is None:
                fisher = posterior.fisher(begun.params)
                _require_determined(posterior, begun, fisher)
                information = fisher + posterior.prior_information(begun.params)
            kept, origin, spent = rejecting(posterior, begun.params)
            known = information if origin is begun.params else None
            again = maximize(kept.posterior, origin, information=known)
            evaluations += spent + again.evaluations
            if top is None or again.distance < CLOSENESS:
                top, found, path = again, kept, begun.path
            if again.distance < NEAR:  # a rough top: other starts end there, too
                break
        assert top is not None, "a first start"
        search = find_modes(found.posterior, top)
        evaluations += search.evaluations
        return found.posterior, _judged(posterior, found, search, evaluations, path)


def _require_determined(posterior: Posterior, begun: Start, fisher: Floats) -> None:
    if weak := undetermined(posterior, begun.params, fisher):
        degree = determined_degree(posterior, begun.params, fisher)
        fewer = "leave out terms"
        if degree:
            fewer += f" of a degree above {degree} (distortion.degree = {degree} in a run file)"
        number = len(posterior.model.sources)
        if begun.path and begun.matched < MATCHED * number:
            fewer += (
                ", check the catalogue's columns, unit and origin (at the start "
                f"{begun.matched} of {number} sources are matched to peaks)"
            )
        raise InputError(
            f"parameters: the frame cannot determine {', '.join(weak)} by its {number} "
            f"source{'s' * (number != 1)}, expected each to move the counts by more than their "
            f"noise: {fewer}, add sources, or give these parameters a narrower prior"
        )


def _starts(posterior: Posterior, start: Sequence[float] | Floats | None) -> Iterator[Start]:
    """Where to begin, and where to restart while no maximum is found."""
    if start is not None:
        yield Start(np.array(start, dtype=np.float64), "", 0)
        return
    begun = find_start(posterior)
    yield begun
    yield from other_starts(posterior, begun)


def _search_frames(
    rejecting: Callable[[Posterior, Floats], tuple[Kept, Floats, int]],
    posterior: JointPosterior,
    start: Sequence[float] | Floats | None,
) -> tuple[JointPosterior, MapEstimate]:
    """The joint posterior of what is kept of several frames, and its maximum."""
    with one_blas_thread():
        found = maximize_frames(posterior, rejecting, start)
        joint, top = found.posterior, found.top
        judged = [
            _fits(posterior.frames[name], kept, joint.frame_params(name, top.params))
            for name, kept in found.kept.items()
        ]
    wrong = [
        f"{name}{how}; {advice}"
        for name, ((fits, advice), how) in zip(found.kept, judged, strict=True)
        if not fits
    ]
    more = f"; and {len(wrong) - MOST_NAMED} more frames" if len(wrong) > MOST_NAMED else ""
    how, advice = f", {len(judged)} frames", "; ".join(wrong[:MOST_NAMED]) + more
    estimate = _estimate(joint, top, found.evaluations, how, (not wrong, advice))
    if found.several:
        one = Modes(top.params[None], top.covariance[None], np.ones(1), 1, complete=False)
        said = f"{estimate.message}; other modes of {', '.join(found.several)}"
        estimate = replace(estimate, modes=one, message=said)
    return joint, estimate


def _judged(
    given: Posterior, kept: Kept, search: ModeSearch, evaluations: int, path: str
) -> MapEstimate:
    """The maximum of what is kept of the given posterior, and whether the model fits there."""
    posterior, top = kept.posterior, search.top
    judged, how = _fits(given, kept, top.params)
    how = f"{path and f' from {path}'}{how}"
    if search.modes is not None and search.modes.count > 1:
        first, second = search.modes.weights[:2]
        how += f", {search.modes.count} modes, the largest with {first:.0%} and {second:.0%}"
    estimate = _estimate(posterior, top, evaluations, how, judged)
    return replace(estimate, modes=search.modes)


def _fits(given: Posterior, kept: Kept, params: Floats) -> tuple[tuple[bool, str], str]:
    """Whether what is kept of a frame fits, with advice, and how many sources are matched."""
    posterior = kept.posterior
    light = source_light(posterior, params)
    how = f", {light.count}"
    fit, rejecting = fit_statistics(posterior, params), posterior is not given
    if rejecting:
        pixels = given.mask.sum() - posterior.mask.sum()
        sources = len(given.model.sources) - len(posterior.model.sources)
        how += f", {sources} sources and {pixels} pixels rejected"
    enough = enough_matched(posterior, light)
    if kept.share > BREAKDOWN:
        return (False, MOSTLY_REJECTED), how
    return (consistent(fit) and enough, _advice(fit, enough, rejecting)), how


def _estimate(
    posterior: TargetDensity,
    top: NewtonResult,
    evaluations: int,
    how: str,
    judged: tuple[bool, str] = (True, ""),
) -> MapEstimate:
    """The record of a maximum, with whether a frame's model fits there and what is said of it."""
    at_maximum, (fits, advice) = top.distance < CLOSENESS, judged
    message = (
        f"gradient {top.distance:.1g} standard deviations from zero after {evaluations} "
        f"evaluations{how}"
    )
    bounds = zip(posterior.parameter_names, top.params, *posterior.support, strict=True)
    if at_bound := [name for name, x, low, high in bounds if x in (low, high)]:
        message += f", {', '.join(at_bound)} at a bound of the prior"
    if not at_maximum:
        remedy = (
            "no step comes closer, as where hardly a pixel of a source is used"
            if top.distance < NEAR
            else "begin elsewhere (start), fit fewer terms, or narrow the priors"
        )
        message = f"not found, {message}: {remedy}"
    else:
        message = f"found, {message}{advice and f'; {advice}'}"
    added = getattr(posterior, "added_covariance", None)
    covariance = top.covariance if added is None else top.covariance + added
    return MapEstimate(top.params, covariance, top.log_prob, evaluations, message, at_maximum, fits)


def _advice(fit: Mapping[str, float], enough: bool, rejecting: bool) -> str:
    """Whether the residuals are consistent with the noise, and what to do where they are not."""
    name = max(("deviance", "pearson"), key=lambda each: abs(misfit(fit, each)))
    excess, said = misfit(fit, name), "deviance" if name == "deviance" else "Pearson's statistic"
    if consistent(fit):
        if enough:
            return "residuals consistent with the noise"
        return (
            "residuals consistent with the noise, but too few sources are matched: check the "
            "catalogue's columns, unit and origin"
        )
    if not excess < 0:
        outliers = "" if rejecting else OUTLIERS
        return (
            f"but the residuals exceed the noise ({said} {excess:.0f} standard deviations above "
            f"its expectation): look at them for a wrong PSF, wrong fluxes, missing terms{outliers}"
        )
    return (
        f"but the residuals are less than the noise ({said} {-excess:.0f} standard deviations "
        "below its expectation): check gain and read noise"
    )

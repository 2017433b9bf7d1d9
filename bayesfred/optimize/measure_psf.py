"""A posterior with a measured PSF: the PSF, the maximum with it, and what its errors take."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.imaging.psf import FWHM, MeasuredPSF
from bayesfred.model.posterior import Posterior
from bayesfred.model.psf_errors import OccamFactor, PsfErrors, covariance_of, refuse_nodes
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import OUTLIERS, find_map
from bayesfred.optimize.fit_psf import find_psf
from bayesfred.optimize.newton import NewtonResult, maximize
from bayesfred.optimize.outliers import reject_once
from bayesfred.optimize.psf_equations import LARGEST_ERROR, SCATTER, PsfState
from bayesfred.optimize.psf_marginal import (
    lit_pixels,
    node_slopes,
    occam_factor,
    shared_information,
)
from bayesfred.optimize.sharp_pixels import sharp_pixels

ROUNDS = 3  # of measuring a PSF without what it does not explain, or with the scatter it leaves
OFF = 0.2  # of the scatter of positions with which a PSF was measured
FEW = 0.1  # of the sources, which may be lost so
MOST = 4  # a degree, beyond which the equations of a PSF take minutes
DARKEST = 1e-3  # expected counts of a pixel to begin with
NODES, EACH = 7, 10  # a number of nodes, and of the sources at each that they take


def measure_psf(
    posterior: Posterior,
    estimate: MapEstimate,
    *,
    oversampling: int = 4,
    degree: int = 0,
    nodes: int = 0,
    model_error: bool = False,
    prior: Mapping[str, Any] | None = None,
    reject_outliers: bool = False,
) -> tuple[Posterior, MapEstimate]:
    """Measure the PSF of a frame, and maximise the posterior with it.

    Where positions scatter it is measured again with the scatter that it leaves, until that rests.

    Parameters
    ----------
    posterior : Posterior
    estimate : MapEstimate
        Its maximum.
    oversampling, degree, nodes : int
        As for `fit_psf`.
    model_error : bool
        Add the model error to the parameters: what the measured PSF leaves. With a PSF that is not
        the frame's it would only slow the search.
    prior : mapping from str to frozen distribution, optional
        Where this has one of the model error.
    reject_outliers : bool
        Mask single pixels within images that are sharper than the PSF, hot or dead ones and cosmic
        rays, and where a model error is fitted what else the PSF does not explain of a few sources;
        and measure it without them.

    Returns
    -------
    posterior : Posterior
        With the measured PSF, whose errors are in those of the parameters.
    estimate : MapEstimate
        Its maximum.

    Raises
    ------
    InputError
        As `fit_psf` and `find_map` do.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65), pixel="box"), bf.SourceCatalog.grid(4, 14.0, 1e5),
    ...     bf.MoffatPSF(3.0, 4.0), bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]))
    >>> counts = bf.simulate(model, [1e-3, 0.0], 5.0, seed=1)
    >>> gaussian = bf.Posterior(bf.ForwardModel(
    ...     model.detector, model.sources, bf.GaussianPSF(1.3), model.distortion), counts)
    >>> estimate = bf.find_map(gaussian)
    >>> posterior, measured = bf.measure_psf(gaussian, estimate)
    >>> estimate.fits_data, measured.fits_data
    (False, True)
    """
    given = {name: own for name, own in (prior or {}).items() if name == "model_error"}
    psf, state, drawn = find_psf(posterior, estimate, oversampling, degree, nodes)
    bare, start = _with(posterior, (psf, state), model_error, given)
    # single sharp pixels hide no others
    rounds = ROUNDS if bare.nuisances.model_error else 1
    for _ in range(rounds if reject_outliers else 0):
        kept = _explained(*_as_measured(bare, start, state))
        if np.array_equal(kept, posterior.mask):
            break
        posterior = replace(posterior, mask=kept, extrapolation=None)
        psf, state, drawn = find_psf(posterior, estimate, oversampling, degree, nodes, state)
        bare, start = _with(posterior, (psf, state), model_error, given)
    top = _maximum(bare, start)
    for _ in range(ROUNDS):
        # with a poor PSF sources seemed to scatter, so that places told little of the PSF
        closer = _scattering(posterior, state, bare.parameter_names, top.params)
        if closer is None:
            break
        psf, state, drawn = find_psf(posterior, estimate, oversampling, degree, nodes, closer)
        bare, start = _with(posterior, (psf, state), model_error, given)
        top = _maximum(bare, start)
    if nodes:
        slopes = node_slopes(bare, state, top.params)
    elif bare.model.optics().translates:
        slopes = covariance_of(drawn @ shared_information(bare, state, top.params))
    else:
        slopes = _slopes(bare, psf, top.params)
    occam = occam_factor(bare, state, top.params) if bare.nuisances.model_error else None
    measured = _marginalized(bare, slopes, top.params, psf.determined, occam)
    found = find_map(measured, top.params)
    if reject_outliers:
        found = replace(found, message=found.message.replace(OUTLIERS, ""))
    return measured, found


def _maximum(bare: Posterior, start: Floats) -> NewtonResult:
    if not np.isfinite(bare.log_prob(start)):
        raise InputError(
            "psf: got one that explains some source with no flux at all, expected images that "
            "resemble each other: reject outliers (reject_outliers), mask what is no source's, or "
            "let the PSF vary less over the field (degree)"
        )
    return maximize(bare, start)


def _scattering(
    posterior: Posterior, state: PsfState, names: Sequence[str], found: Floats
) -> PsfState | None:
    """The state with the positions' scatter that was found, if that is another one."""
    if SCATTER not in names:
        return None
    params, k = state.params.copy(), posterior.parameter_names.index(SCATTER)
    before, params[k] = params[k], found[names.index(SCATTER)]
    return replace(state, params=params) if abs(params[k] - before) > OFF * before else None


def _explained(posterior: Posterior, params: Floats) -> Flags:
    """The pixels without those that a measured PSF does not explain.

    Where no model error tells what the PSF leaves of the sources, these are single pixels alone,
    and so they are where many sources would be lost: then it is the model that does not fit.
    """
    kept = posterior.mask & ~sharp_pixels(posterior, params)
    if not posterior.nuisances.model_error:
        return kept
    found = reject_once(replace(posterior, mask=kept, extrapolation=None), params)
    return found.posterior.mask if found.share <= FEW else kept


def _with(
    posterior: Posterior,
    found: tuple[MeasuredPSF, PsfState],
    model_error: bool,
    prior: Mapping[str, Any],
) -> tuple[Posterior, Floats]:
    """The posterior with a PSF but without the PSF's errors, and about its maximum."""
    psf, state = found
    bare = posterior.with_psf(psf)
    known = dict(zip(posterior.parameter_names, state.params, strict=True))
    if model_error:
        bare = replace(
            bare, nuisances=replace(bare.nuisances, model_error=True), prior={**bare.prior, **prior}
        )
    known.setdefault("model_error", min(max(psf.model_error, 1e-3), LARGEST_ERROR))
    start = np.array([known[name] for name in bare.parameter_names])
    if bare.nuisances.model_error:
        # a source that shows its wings alone has any flux whose error covers what is wrong there
        bare = replace(bare, mask=lit_pixels(posterior, state), extrapolation=None)
    if not np.isfinite(bare.log_prob(start)):
        # its equations do not know that no mean is below 0, which in a dark frame its wings may be
        bare = bare.with_psf(_not_negative(psf))
        start = np.clip(start, *bare.support)
        darkest = bare.expected_counts(start)[bare.mask].min()
        start[bare.parameter_names.index("background")] += max(DARKEST - darkest, 0.0)
    return bare, start


def _not_negative(psf: MeasuredPSF) -> MeasuredPSF:
    """That which is nowhere on the field below 0: of what varies no more than the constant has."""
    first, rest = np.maximum(psf.coefficients[0], 0.0), psf.coefficients[1:]
    sizes = np.abs(rest)
    most = sizes.max(axis=0, initial=0.0) if psf.nodes else sizes.sum(axis=0)
    kept = np.minimum(first / np.maximum(most, 1e-300), 1.0)
    return replace(psf, coefficients=np.concatenate([first[None], kept * rest]))


def _as_measured(posterior: Posterior, params: Floats, state: PsfState) -> tuple[Posterior, Floats]:
    """A posterior whose fluxes and positions are known, as the PSF was measured with them.

    Beside light that is no source's the most likely flux may be one that is so large that the
    model's error covers it.
    """
    nuisances, sources = posterior.nuisances, posterior.model.sources
    if nuisances.flux != "free":
        return posterior, params
    (dx, dy), known = state.shifts.T, dict(zip(posterior.parameter_names, params, strict=True))
    sources = replace(sources, x=sources.x + dx, y=sources.y + dy, flux=state.fluxes)
    measured = replace(
        posterior,
        model=replace(posterior.model, sources=sources),
        nuisances=replace(nuisances, flux="fixed", position_scatter=False),
        prior={name: own for name, own in posterior.prior.items() if name != "position_scatter"},
        extrapolation=None,
    )
    return measured, np.array([known[name] for name in measured.parameter_names])


def marginalize_psf(posterior: Posterior, estimate: MapEstimate) -> Posterior:
    """Let the errors of a PSF that was measured on another frame widen those of the parameters.

    Parameters
    ----------
    posterior : Posterior
        With a `MeasuredPSF`.
    estimate : MapEstimate
        Its maximum.

    Returns
    -------
    Posterior
        With `psf_errors` about that maximum: find it again, for its covariance.

    Raises
    ------
    InputError
        If the PSF was not measured, or has no draws; or if it varies between nodes.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65), pixel="box"), bf.SourceCatalog.grid(4, 14.0, 1e5),
    ...     bf.GaussianPSF(1.3), bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]))
    >>> first, second = (bf.Posterior(model, bf.simulate(model, [1e-3, 0.0], 5.0, seed=seed))
    ...                  for seed in (1, 2))
    >>> other = second.with_psf(bf.fit_psf(first, bf.find_map(first)))
    >>> known = bf.find_map(other)
    >>> widened = bf.find_map(bf.marginalize_psf(other, known))
    >>> bool(np.all(np.diag(widened.covariance) > np.diag(known.covariance)))
    True
    """
    psf = posterior.model.psf
    if not isinstance(psf, MeasuredPSF) or psf.draws is None:
        raise InputError(
            f"psf: got {type(psf).__name__} without draws, expected a MeasuredPSF with its errors: "
            "fit_psf makes one"
        )
    refuse_nodes(psf)
    bare = replace(posterior, psf_errors=None)
    return _marginalized(bare, _slopes(bare, psf, estimate.params), estimate.params, 0.0)


def psf_message(posterior: Posterior, estimate: MapEstimate) -> str:
    """Say in a line what was found of a PSF.

    Parameters
    ----------
    posterior : Posterior
        With a `MeasuredPSF`.
    estimate : MapEstimate
        Its maximum.

    Returns
    -------
    str
    """
    psf = posterior.model.psf
    assert isinstance(psf, MeasuredPSF), "one was measured"
    errors = posterior.psf_errors
    here = "" if errors is None or errors.absorbed else " on another frame"
    varies = f", {psf.variation} over the field" if psf.varies else ""
    known = dict(zip(posterior.parameter_names, estimate.params, strict=True))
    error = known.get("model_error", psf.model_error)
    left = f", {error:.1%} of the light unexplained" if error else ""
    if error > LARGEST_ERROR:
        left += f": {varying_more(posterior)}"
    return (
        f"psf: measured{here}, FWHM {FWHM * psf.sigma:.2f} pixel with the pixel in it{varies}, "
        f"{psf.determined:.0f} numbers determined{left}"
    )


def varying_more(posterior: Posterior) -> str:
    """What to do where a measured PSF is not good enough; empty of a PSF that was not measured."""
    psf, sources = posterior.model.psf, len(posterior.model.sources)
    if not isinstance(psf, MeasuredPSF):
        return ""
    if psf.nodes:
        more = f"psf.nodes = {psf.nodes + 4}"
    elif psf.degree >= MOST or sources >= EACH * NODES**2:
        more = f"psf.nodes = {NODES}"
    else:
        more = f"psf.degree = {psf.degree + 2}"
    instead = " in place of psf.degree" if psf.degree and "nodes" in more else ""
    return f"let the PSF vary more over the field ({more}{instead})"


def _slopes(posterior: Posterior, psf: MeasuredPSF, centre: Floats) -> Floats:
    """The covariance of the gradients with the PSFs that were drawn, shape (d, d)."""
    slopes = []
    for drawn in psf.drawn():
        likelihood = replace(posterior.likelihood, model=replace(posterior.model, psf=drawn))
        likelihood.share_frame(posterior.likelihood)
        slopes.append(likelihood.gradient(centre))
    return covariance_of(np.array(slopes))


def _marginalized(
    posterior: Posterior,
    slopes: Floats,
    centre: Floats,
    absorbed: float,
    occam: OccamFactor | None = None,
) -> Posterior:
    information = posterior.information(centre)
    errors = PsfErrors.of(posterior.parameter_names, information, slopes, absorbed, occam)
    return replace(posterior, psf_errors=errors)

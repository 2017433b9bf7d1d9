"""The figures of a page: which there are, what is said below them, and what they show in words.

An alternative text says with numbers what a reader sees in the figure. The figures themselves are
those of `bayesfred.reporting.frames` and `bayesfred.reporting.posteriors`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats
from bayesfred.analysis.diagnostics import Diagnostics
from bayesfred.analysis.field import DisplacementField
from bayesfred.imaging.psf import MeasuredPSF
from bayesfred.model.noise import SubtractedNoise
from bayesfred.model.posterior import Posterior
from bayesfred.reporting.field import field_plot
from bayesfred.reporting.frames import MAX_STARS, FittedFrame, background_panels, star_panels
from bayesfred.reporting.goodness import described_residuals, residual_panels
from bayesfred.reporting.pairs import corner_plot, described_pairs, pairs_caption
from bayesfred.reporting.posteriors import marginal_plot, trace_plot
from bayesfred.reporting.psf import described_psf, psf_panels
from bayesfred.reporting.style import png
from bayesfred.sampling.chain import Chain

__all__ = ["PageFigure", "described_residual", "page_figures"]

BEYOND = 3.0  # standard deviations; a normal residual is beyond with a probability of 0.27 %


class PageFigure(NamedTuple):
    """A figure of the page.

    Attributes
    ----------
    heading, caption : str
        What stands above and below it.
    alternative : str
        What is seen in it, for those who do not see it.
    content : bytes
        The PNG file.
    """

    heading: str
    caption: str
    alternative: str
    content: bytes


def page_figures(
    fitted: FittedFrame,
    chain: Chain,
    diagnostics: Diagnostics,
    field: DisplacementField,
    *,
    picture: bytes,
    shown: Sequence[int],
    truth: Floats | None = None,
) -> list[PageFigure]:
    """The figures of a run's page.

    Parameters
    ----------
    fitted : FittedFrame
        The frame with the model at the MAP.
    chain : Chain
    diagnostics : Diagnostics
        What `diagnose` said of `chain`.
    field : DisplacementField
        Of the chain; its figure comes first.
    picture : bytes
        The PNG file of `bayesfred.reporting.posteriors.overview`.
    shown : sequence of int
        Indices of the parameters that are shown in pairs; the others have histograms.
    truth : ndarray, shape (d,), parameter units, optional
        Values that a simulation used.

    Returns
    -------
    list of PageFigure
    """
    posterior = chain.posterior()
    detector = posterior.model.detector
    known = dict(zip(posterior.parameter_names, chain.estimate.params, strict=True))
    scatter = float(known.get("position_scatter", 0.0))
    u, v, half_width = _star_positions(chain, posterior)
    figures = [
        PageFigure(
            "Displacement",
            "Above: from the object to its image, with the error that the posterior gives it. What "
            "is hatched lies beyond the sources, where only the terms of the distortion say what "
            "happens; its ellipses are grey, and left out where they are large. Below: by how much "
            "the counts of each source say that its image is off the place where the model has it; "
            "arrows that agree with their neighbours mean a missing term. The longest arrows are "
            "left out; a cross stands for one of more than 3 standard deviations.",
            field.message,
            png(field_plot(field, diagnostics.sources, detector.binning, scatter)),
        ),
        PageFigure(
            "Frame, model and residual",
            "At the MAP. Green pixels do not enter the likelihood. Below: how many standard "
            f"deviations the posterior is away from {'zero' if truth is None else 'the truth'}.",
            f"{_described_frame(fitted)} {described_residual(fitted)}",
            picture,
        ),
        PageFigure(
            "Brightest sources",
            "Labelled with u, v in pixels from the middle. A dipole in a residual is a misplaced "
            "source.",
            _described_stars(fitted, u, v),
            png(star_panels(fitted, u, v, half_width=half_width)),
        ),
        *_background_figures(posterior, chain.estimate.params),
        *_psf_figures(posterior),
        *_residual_figures(diagnostics, posterior),
        *_posterior_figures(chain, shown, truth),
    ]
    if chain.method == "mcmc":
        figures.append(
            PageFigure(
                "Chain",
                "Median and middle 68 % of each ensemble's walkers; histograms of their ranks, "
                "flat at 1 when all ensembles sample one distribution.",
                _described_chain(chain, diagnostics),
                png(trace_plot(chain, posterior.parameters), shades=False),
            )
        )
    return figures


def _background_figures(posterior: Posterior, params: Floats) -> list[PageFigure]:
    """The background, if its structure was measured and subtracted."""
    noise = posterior.noise.pixelwise
    if not isinstance(noise, SubtractedNoise):
        return []
    background = posterior.likelihood.background(params) + noise.light
    light = noise.light[posterior.mask]
    return [
        PageFigure(
            "Background",
            "The frame before its background's structure was subtracted, and that structure with "
            "the background that was fitted to the rest, on one scale. Errors of the structure are "
            "not in those of the parameters.",
            f"The background reaches from {background[posterior.mask].min():.4g} to "
            f"{background[posterior.mask].max():.4g} counts per pixel among the sources. What was "
            f"subtracted of it varies by {light.std():.3g} counts per pixel (root mean square).",
            png(background_panels(posterior.counts + noise.light, background, posterior.mask)),
        )
    ]


def _psf_figures(posterior: Posterior) -> list[PageFigure]:
    """The PSF, if it was measured."""
    psf = posterior.model.psf
    if not isinstance(psf, MeasuredPSF):
        return []
    return [
        PageFigure(
            "Point spread function",
            "As measured, with the pixel's response in it; bands hold 95 % of the draws from its "
            f"posterior. {psf.determined:.0f} numbers of it are determined by the counts.",
            described_psf(psf),
            png(psf_panels(psf, posterior.model.detector.shape)),
        )
    ]


def _residual_figures(diagnostics: Diagnostics, posterior: Posterior) -> list[PageFigure]:
    """What the residuals show, of a posterior of a frame."""
    if diagnostics.residuals is None:
        return []
    return [
        PageFigure(
            "Residuals",
            "Their distribution beside that of a true model, the displacement of the sources "
            "against the position of their images within a pixel, and every source's chi-square.",
            described_residuals(diagnostics.residuals),
            png(residual_panels(diagnostics.residuals, posterior.model.detector.shape)),
        )
    ]


def _posterior_figures(
    chain: Chain, shown: Sequence[int], truth: Floats | None
) -> list[PageFigure]:
    """Pairs of the parameters that are shown so, and histograms of the others."""
    draws, posterior = chain.draws(), chain.posterior()
    estimate, parameters = chain.estimate.params, posterior.parameters
    rest = [k for k in range(draws.shape[1]) if k not in shown]
    figures = [
        PageFigure(
            "Posterior",
            pairs_caption(len(shown), draws.shape[1]),
            described_pairs(draws, chain.parameter_names, shown),
            png(corner_plot(draws, parameters, shown=shown, truth=truth, estimate=estimate)),
        )
    ]
    if rest:
        names = [chain.parameter_names[k] for k in rest]
        figures.append(
            PageFigure(
                "Posterior: other parameters",
                "Draws, and the density of the prior: next to zero where the prior is much wider.",
                _described_marginals(draws[:, rest], names, posterior),
                png(
                    marginal_plot(
                        draws[:, rest], [parameters[k] for k in rest], posterior.prior,
                        truth=None if truth is None else truth[rest], estimate=estimate[rest],
                    ),
                    shades=False,
                ),
            )
        )  # fmt: skip
    return figures


def described_residual(fitted: FittedFrame) -> str:
    """Say what is seen in an image of residuals.

    Parameters
    ----------
    fitted : FittedFrame

    Returns
    -------
    str

    Examples
    --------
    >>> ones = np.ones((2, 2))
    >>> described_residual(FittedFrame(ones + 4 * np.eye(2), ones, ones, ones > 0))
    'Residuals between 0.0 and 4.0 standard deviations; 50.00 % of 4 pixels are beyond 3, ...'
    """
    residual = fitted.residual()[fitted.mask]
    if not residual.size:
        return "No pixel is used."
    beyond = np.mean(np.abs(residual) > BEYOND)
    return (
        f"Residuals between {residual.min():.1f} and {residual.max():.1f} standard deviations; "
        f"{100 * beyond:.2f} % of {residual.size} pixels are beyond {BEYOND:.0f}, where normal "
        "residuals would have 0.27 %."
    ).replace("-", "−")


def _described_frame(fitted: FittedFrame) -> str:
    ny, nx = fitted.counts.shape
    counts, expected = fitted.counts[fitted.mask], fitted.expected[fitted.mask]
    if not counts.size:
        return f"A frame of {ny} × {nx} pixels."
    return (
        f"A frame of {ny} × {nx} pixels with {counts.min():.4g} to {counts.max():.4g} counts a "
        f"pixel, beside a model with {expected.min():.4g} to {expected.max():.4g}."
    )


def _described_stars(fitted: FittedFrame, u: Floats, v: Floats) -> str:
    ny, nx = fitted.counts.shape
    inside = int(np.sum((np.abs(u) <= nx / 2) & (np.abs(v) <= ny / 2)))
    number = min(inside, MAX_STARS)
    which = (
        f"the {number} brightest of {inside} sources" if inside > number else f"{number} sources"
    )
    return f"Counts, model and residual side by side around {which} in the frame."


def _described_marginals(draws: Floats, names: Sequence[str], posterior: Posterior) -> str:
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = draws.std(axis=0) / np.array([posterior.prior[name].std() for name in names])
    widest = int(np.argmax(np.nan_to_num(ratio, posinf=0.0)))
    return (
        f"Histograms of {len(names)} parameters with their priors. At most a posterior is "
        f"{ratio[widest]:.2g} times as wide as its prior, that of {names[widest]}."
    )


def _described_chain(chain: Chain, diagnostics: Diagnostics) -> str:
    ensembles, steps, walkers, d = chain.chain.shape
    worst, rhat = max(diagnostics.rhat.items(), key=lambda item: item[1])
    return (
        f"Traces and rank histograms of {d} parameters: {ensembles} ensembles of {walkers} walkers "
        f"over {steps} steps, the first {chain.burn_in} of them burn-in. Ensembles differ most in "
        f"{worst}, with an R-hat of {rhat:.3f}."
    )


def _star_positions(chain: Chain, posterior: Posterior) -> tuple[Floats, Floats, int]:
    """Images of the sources in recorded pixels from the middle, and a stamp's half-width."""
    model = posterior.model
    params = dict(zip(chain.parameter_names, chain.estimate.params, strict=True))
    u, v = posterior.likelihood.image_positions(chain.estimate.params).T
    binning = model.detector.binning
    half_width = max(4, math.ceil(3.5 * params.get("psf_sigma", model.psf.sigma) / binning))
    return u / binning, v / binning, half_width

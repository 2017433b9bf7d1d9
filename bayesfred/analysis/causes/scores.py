"""Causes that sums over all pixels hide: numbers that are wrong, and sources that are.

They come from the tests of `bayesfred.analysis.score_tests` and `bayesfred.analysis.source_tests`.
The misfit that they share out is that of the sources' own scores: the excess of the sum of their
squares. Numbers in the model explain the squares of their scores, one beside those before it. Terms
of the distortion are freed together, and positions that scatter give scores to all of them. So the
terms explain the joint chi-square of their scores, less what the sources' positions would give to
so many numbers if they scattered by what the terms leave. Scatter explains the rest.
"""

import math
from dataclasses import replace

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.causes.cause import (
    MISSING,
    RICHER,
    Cause,
    Finding,
    psf_remedy,
    rows_named,
    scatter_remedy,
    terms_remedy,
)
from bayesfred.analysis.causes.find import ranked
from bayesfred.analysis.causes.light import FEW
from bayesfred.analysis.score_tests import Lead, ScoreTests
from bayesfred.analysis.source_tests import KINDS, SourceTests, are_bright
from bayesfred.imaging.monomials import degree_of
from bayesfred.model.posterior import Posterior

NOISE = 2.0  # standard deviations by which a spread has to explain more than chance
TINY = 1e-6  # a relative change that is not shown
MORE_TERMS = (MISSING, "")
# The cause, and what frees a number that a score test finds wrong, by the beginning of its name.
REMEDIES = {
    "flux_scale": ("fluxes", 'set nuisances.flux = "scale"'),
    "offset": ("shift", "set nuisances.offset = true"),
    "psf_sigma": ("PSF", "let it be free (nuisances.psf_sigma = true), or correct the PSF's width"),
    "background": ("background", "raise nuisances.background_order"),
    "f_": MORE_TERMS,
    "g_": MORE_TERMS,
}
# Which columns of the sources' deviates, and what is found.
SPREADS = {
    "fluxes": (
        "light",
        "the sources have other fluxes than the catalogue's, by some {:.1%} each",
    ),
    "positions": (
        "position",
        "the sources lie off their places, by some {:.2g} pixels along each axis",
    ),
}


def hidden_causes(
    posterior: Posterior, params: Floats, scores: ScoreTests, tests: SourceTests
) -> tuple[Cause, ...]:
    """The failed tests as causes.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    scores : ScoreTests
    tests : SourceTests

    Returns
    -------
    tuple of Cause
        The most likely one first; empty where no test fails.
    """
    squares = np.where(np.isfinite(tests.z), tests.z**2 - 1.0, 0.0)
    own = np.sum(squares[:, 1:], axis=1)
    findings = [
        _terms(_numbers(posterior, which, leads), leads, scores, tests)
        if which == MORE_TERMS
        else _numbers(posterior, which, leads)
        for which, leads in _by_remedy(scores.leading).items()
    ]
    failed = np.flatnonzero(tests.failed)
    few = failed.size <= max(2, FEW * own.size)
    if failed.size and few:
        # what no score describes shows in the chi-square
        held = np.maximum(own, squares[:, 0])[failed]
        bright = are_bright(posterior.fluxes(params), tests.failed)
        order = failed[np.argsort(-held)]
        findings.append(_few_sources(posterior, order, float(held.sum()), bright))
    elif failed.size:
        profile = float(squares[:, [0, *KINDS["size and shape"]]].sum())
        text = f"{failed.size} of {own.size} sources do not look like the PSF"
        cause = Cause("PSF", 0.0, text, psf_remedy(posterior, "fit another PSF"))
        findings.append(Finding(cause, profile, "PSF", RICHER))
    others = squares[~tests.failed] if few else squares
    smooth = sum(finding.explained for finding in findings if finding.cause.name == MISSING)
    for spread in tests.failed_spreads:
        kind, text = SPREADS[spread.name]
        remedy, pixel, taken = 'set nuisances.flux = "free"', 1.0, 0.0
        if spread.name == "positions":
            remedy, pixel = scatter_remedy(posterior), posterior.model.detector.binning
            taken = smooth
        cause = Cause(spread.name, 0.0, text.format(spread.estimate / pixel), remedy)
        some = others[:, KINDS[kind]]
        explained = float(some.sum()) - NOISE * (2.0 * some.size) ** 0.5 - taken
        findings.append(Finding(cause, explained, spread.name, RICHER))
    parts = [finding.explained for finding in findings]
    every = sum(max(part, 0.0) for part in parts)
    # many sources that are slightly off, none so that it fails, hide no test that does
    return ranked(findings, max([float(own.sum()), *parts])) or ranked(findings, every)


def _by_remedy(leading: tuple[Lead, ...]) -> dict[tuple[str, str], list[Lead]]:
    """Numbers that go by the same name and remedy."""
    groups: dict[tuple[str, str], list[Lead]] = {}
    for lead in leading:
        which = next(text for start, text in REMEDIES.items() if lead.name.startswith(start))
        groups.setdefault(which, []).append(lead)
    return groups


def _numbers(posterior: Posterior, which: tuple[str, str], leads: list[Lead]) -> Finding:
    """Numbers that are wrong."""
    (name, remedy), first = which, leads[0]
    if name == "PSF":
        remedy = psf_remedy(posterior, remedy)
    change = max(abs(first.step / first.value), TINY) if first.value else 1.0
    digits = max(4, 2 - math.floor(math.log10(change)))  # that show it
    text = (
        f"{first.name} is {abs(first.z):.0f} standard deviations from zero score: the counts ask "
        f"for {first.value + first.step:.{digits}g} in place of {first.value:.{digits}g}"
    )
    if more := ", ".join(lead.name for lead in leads[1:]):
        text += f" (further: {more})"
    return Finding(Cause(name, 0.0, text, remedy), sum(lead.z**2 for lead in leads), name)


def _terms(finding: Finding, leads: list[Lead], scores: ScoreTests, tests: SourceTests) -> Finding:
    """Terms of the distortion that are missing."""
    joint, number = scores.joint(("f_", "g_"))
    place = tests.z[:, KINDS["position"]]
    others = max(int(np.isfinite(place).sum()) - number, 1)
    each = max((float(np.nansum(place**2)) - joint) / others, 1.0)
    explained = max(leads[0].z ** 2 - each, joint - number * each)
    remedy = terms_remedy(max(degree_of(lead.name) for lead in leads))
    return replace(finding, cause=replace(finding.cause, remedy=remedy), explained=explained)


def _few_sources(posterior: Posterior, failed: Ints, explained: float, are_bright: bool) -> Finding:
    """Sources that differ from the catalogue, or the brightest, which show what all have wrong."""
    s = posterior.model.sources
    rows = rows_named(s, failed)
    if are_bright:
        cause = Cause(
            "PSF", 0.0,
            f"{failed.size} of {len(s)} sources do not fit, and they are bright: what is slightly "
            f"wrong with all shows there first: {rows}",
            psf_remedy(posterior, 'measure the PSF (psf.kind = "measured")')
            + ", or leave the brightest out if their images differ, as a detector may make them",
        )  # fmt: skip
        return Finding(cause, explained, "PSF", RICHER)
    cause = Cause(
        "wrong sources", 0.0, f"{failed.size} of {len(s)} sources do not fit: {rows}",
        "correct their positions and fluxes, or leave them out",
    )  # fmt: skip
    return Finding(cause, explained, "wrong sources", RICHER)

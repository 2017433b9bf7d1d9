"""Hypotheses about pixels: saturation, colour filters, the read-out's lines, noise, background."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy import ndimage

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.causes.background import background_between, background_outside
from bayesfred.analysis.causes.cause import Cause, Finding
from bayesfred.analysis.causes.common import common_pattern
from bayesfred.analysis.causes.context import Context
from bayesfred.analysis.neighbours import Neighbours
from bayesfred.analysis.shared_noise import SharedNoise, shared_noise
from bayesfred.model.noise import PoissonNoise, correlation_ratio

FEWEST_FULL = 3  # equal pixels at the top that are a pile
UNLIKELY = 1e-6  # chance of such a pile
TILE = 16  # pixels a side of the squares in which the noise is measured
FEWEST_QUIET = 24  # of a tile's pixels, or it does not count
FEWEST_TILES = 5
NOTICEABLE = 5.0  # standard deviations
OUTLYING = 3.0  # standard deviations, as which a pixel of a line counts at most
AROUND = 9  # lines, among which one is compared
FEW_LINES = 0.05  # of the lines: more than these are all
NAMED = 5  # lines listed
LINES = "rows or columns"
STEEPEST = (
    30.0  # times the background's, to which noise in proportion to the counts is extrapolated
)


def full_pixels(context: Context) -> tuple[Flags, float]:
    """Saturated pixels, shape (ny, nx), and the value that they hold.

    Of bright pixels hardly two hold one value: where k pixels have counts within 3 standard
    deviations below the largest, spread over w possible values, k / w of them hold the largest by
    chance. A pile has many more.
    """
    counts, used = context.posterior.counts, context.posterior.mask
    none = np.zeros(counts.shape, bool), 0.0
    values = counts[used]
    top = float(values.max())
    scale = float(np.median(context.variance[used])) ** 0.5
    if top < context.level + 10.0 * scale:
        return none
    below = np.unique(values[values > 0.5 * top])
    step = float(np.diff(below).min()) if below.size > 1 else 1.0
    sd = max(top, 1.0) ** 0.5 * max(scale / max(context.level, 1.0) ** 0.5, 1.0)
    near = int(np.sum((values < top) & (values >= top - 3.0 * sd)))
    pile = int(np.sum(values == top))
    chance = max(near, 1) * step / (3.0 * sd)
    # the tail of Poisson's distribution is below its first term times e
    tail = pile * np.log(chance) - pile * (np.log(pile) - 1.0)
    if pile < FEWEST_FULL or chance >= pile or tail > np.log(UNLIKELY):
        return none
    return used & (counts == top), top


def saturation(context: Context) -> tuple[Finding | None, Flags]:
    """A pile of pixels at one value, and the pixels that they spoil."""
    full, top = full_pixels(context)
    if not full.any():
        return None, full
    s = context.light.width
    spoiled = ndimage.distance_transform_edt(~full) <= np.ceil(3.0 * s)
    held = float(np.sum((context.z**2 - context.used)[spoiled]))
    touched = np.zeros(context.flux.size, bool)
    owners = context.owner[full & (context.distance <= 3.0 * s)]
    touched[owners[owners >= 0]] = True
    # what sources hold that are not saturated is another cause's
    others = context.light.matched & ~touched & (context.power > 0.0)
    like = 0.0
    if others.any():
        like = float(context.source_excess[others].sum() / context.power[others].sum())
    explained = held - max(like, 0.0) * float(context.power[touched].sum())
    row, column = (int(k[0]) for k in np.nonzero(full))
    cause = Cause(
        "saturation", 0.0,
        f"{full.sum()} pixels at {touched.sum()} sources hold the frame's largest value, {top:g} "
        f"counts, such as row {row}, column {column}: they are saturated",
        "mask them: set frame.saturation",
    )  # fmt: skip
    return Finding(cause, explained, "saturation"), np.asarray(spoiled & context.posterior.mask)


def alternation(context: Context) -> tuple[list[Finding], Context]:
    """Even and odd rows and columns that differ, and what is left if they are expected to.

    Pixels of a colour camera, behind filters, record other shares of the light; where rows or
    columns are read by amplifiers of their own, other constants are added.
    """
    ny, nx = context.expected.shape
    kind = np.arange(ny)[:, None] % 2 * 2 + np.arange(nx) % 2
    found, change = None, context.expected
    for of_light, unit in ((True, context.expected), (False, np.ones(kind.shape))):
        t = np.where(context.used, unit / np.sqrt(context.variance), 0.0)
        pull, power = (np.bincount(kind.ravel(), (t * each).ravel(), 4) for each in (context.z, t))
        size = pull / np.maximum(power, 1e-300)
        explained = float(pull @ size - pull.sum() ** 2 / max(power.sum(), 1e-300)) - 3.0
        if explained > max(NOTICEABLE * 6.0**0.5, found.explained if found else 0.0):
            found = Finding(_alternating(size, of_light), explained, "alternation")
            change = size[kind] * unit
    if found is not None:
        # of sources on a regular grid a wrong PSF favours even pixels, too
        shared = common_pattern(context, (0, 2))
        if shared is not None and shared.explained > found.explained:
            found = None
    return ([], context) if found is None else ([found], context.corrected_by(change))


def _alternating(size: Floats, of_light: bool) -> Cause:
    a, b, c, d = (f"{1.0 + x:.3f}" if of_light else f"{x:+.2g}" for x in size)
    what = "times the model's counts" if of_light else "counts more than the model has"
    return Cause(
        "alternating pixels", 0.0,
        f"even and odd rows and columns differ: pixels of even rows hold {a} (even columns) and "
        f"{b} (odd ones) {what}, those of odd rows {c} and {d}; the first row and column are even",
        "take the pixels of one colour if the camera has a colour filter, or set frame.flat to "
        "the relative response of every pixel" if of_light else "subtract a dark frame first",
    )  # fmt: skip


def lines(context: Context) -> tuple[list[Finding], Context]:
    """Rows or columns unlike the others, and what is left without what is wrong with them.

    Dead or hot ones are few; where the read-out adds a constant to each there are many. A constant
    is the mean residual of a line's pixels between the sources, less that of the lines around it;
    a cosmic ray hardly counts.
    """
    findings = []
    for axis, name in enumerate(("columns", "rows")):
        z, sd = np.clip(context.z, -OUTLYING, OUTLYING), np.sqrt(context.variance)
        quiet = np.where(context.quiet, 1.0 / sd**2, 0.0).sum(axis=axis)
        pull = np.where(context.quiet, z / sd, 0.0).sum(axis=axis)
        known = quiet > 0.0
        size = np.where(known, pull / np.where(known, quiet, 1.0), 0.0)
        size -= ndimage.median_filter(size, AROUND)
        odd = np.abs(size) * np.sqrt(quiet) > NOTICEABLE
        if 0 < odd.sum() <= FEW_LINES * size.size:
            here = odd[None] if axis == 0 else odd[:, None]
            held = float(np.sum(np.where(here, context.z**2 - context.used, 0.0)))
            left = replace(context, left_out=context.left_out | here)
            which = ", ".join(map(str, np.flatnonzero(odd)[:NAMED]))
            more = ", ..." if odd.sum() > NAMED else ""
            sentence = f"{odd.sum()} {name} are unlike the others: {which}{more}, from 0"
            remedy = "mask them: NaN in the frame"
        else:
            constant = np.broadcast_to(size if axis == 0 else size[:, None], context.z.shape)
            z = (context.residual - constant) / sd
            held = float(np.sum(np.where(context.used, context.z**2 - z**2, 0.0))) - size.size
            left = context.corrected_by(constant)
            sentence = (
                f"all {name} have constants of their own, by {size.std():.2g} counts (root mean "
                "square): the read-out adds them"
            )
            remedy = f"subtract from the {name} what their pixels between the sources tell of it"
        if held > NOTICEABLE * (2.0 * size.size) ** 0.5:
            findings.append(Finding(Cause(LINES, 0.0, sentence, remedy), held, name))
            context = left
    return findings, context


def correlated_pixels(shared: SharedNoise) -> Cause:
    """Noise that neighbouring pixels share, about which hardly anything else can be said."""
    along_u, along_v = shared.along
    taken = f", not {shared.known:g} times" if shared.known != 1.0 else ""
    return Cause(
        "correlated pixels", 1.0,
        f"neighbouring pixels between the sources share noise (correlation {along_u:.2f} along u, "
        f"{along_v:.2f} along v), as in frames that were resampled, smoothed or sharpened: errors "
        f"of positions are {shared.ratio:.2g} times those with independent pixels{taken}",
        f"set frame.noise_correlation_ratio = {shared.ratio:.2g}, or fit the frame as the detector "
        "recorded it",
    )  # fmt: skip


def displaced_alike(found: Neighbours, *, scatters: bool) -> Cause:
    """What displaces neighbouring sources alike, and is in no term of the distortion.

    Where positions scatter a fit has such displacements in its errors but for what terms describe.
    """
    remedy = "add terms to the distortion"
    if not scatters:
        remedy += (
            ", or set nuisances.position_scatter = true, by which a fit has such displacements in "
            "its errors"
        )
    return Cause(
        "displaced neighbours", 1.0,
        f"neighbouring sources are displaced alike (correlation {found.correlation:.2f}), by what "
        "is finer than the distortion's terms and not independent from source to source, such as "
        "ghosts or the target's own errors: errors of the coefficients are some "
        f"{found.factor:.2g} times these",
        remedy,
    )  # fmt: skip


def background_and_noise(context: Context) -> Iterator[Finding]:
    """What pixels far from all sources say of the background and of the noise."""
    known = correlation_ratio(context.posterior.noise)
    shared = shared_noise(context.z, context.quiet, context.light.width, known)
    if shared is None:
        yield from _independent(context)
        return
    # what independent pixels would say of both is said of the correlation
    explained = sum(finding.explained for finding in _independent(context))
    yield Finding(correlated_pixels(shared), explained, "noise")


def _independent(context: Context) -> Iterator[Finding]:
    """The same of pixels that share no noise."""
    mean, scatter, size, place = _tiles(context)
    if mean.size < FEWEST_TILES:
        yield from background_outside(context)
        return
    order = np.argsort(scatter)
    kept = order[mean.size // 10 : mean.size - mean.size // 10]
    ratio = float(np.average(scatter[kept], weights=size[kept]))
    ratio = max(ratio / _level(context), 1e-9)
    everywhere = context.used.sum() / max(size.sum(), 1)
    yield from background_between(context, (mean, size, place), ratio, float(everywhere))
    sd = (2.0 / size[kept].sum()) ** 0.5 * _tail(context)
    if abs(ratio - 1.0) > NOTICEABLE * max(sd, 1e-9) + 0.02:
        yield _noise(context, ratio)


def _level(context: Context) -> float:
    """Counts over expected counts of the quiet pixels: a wrong level is no wrong noise."""
    noise = context.posterior.noise.pixelwise
    if not isinstance(noise, PoissonNoise):
        return 1.0
    mu = float(np.mean(noise.counts_variance(context.expected, context.level)[context.quiet]))
    return max((mu + float(np.mean(context.residual[context.quiet]))) / max(mu, 1e-9), 0.1)


def _tail(context: Context) -> float:
    """By how much counts so few scatter more in their squares than normal numbers."""
    return float(np.sqrt(1.0 + 0.5 / max(np.median(context.variance[context.used]), 1e-3)))


def _tiles(context: Context) -> tuple[Floats, Floats, Floats, Floats]:
    """Mean of z, its variance, number and place of the quiet pixels in every square."""
    ny, nx = context.quiet.shape
    row, column = np.nonzero(context.quiet)
    z = context.z[row, column]
    across = -(-nx // TILE)
    tile = row // TILE * across + column // TILE
    size = np.bincount(tile, minlength=across * -(-ny // TILE)).astype(float)
    enough = size >= FEWEST_QUIET

    def averaged(values: Floats) -> Floats:
        return np.asarray(np.bincount(tile, values, size.size)[enough] / size[enough])

    mean, n = averaged(z), size[enough]
    scatter = (averaged(z**2) - mean**2) * n / (n - 1.0)
    u, v = averaged(column / max(nx - 1, 1) * 2.0 - 1.0), averaged(row / max(ny - 1, 1) * 2.0 - 1.0)
    return mean, scatter, n, np.stack([u, v])


def _noise(context: Context, ratio: float) -> Finding:
    """Which law of the variance makes the scatter between the sources, and at them.

    With mu the expected counts and b those of the background, the squares of z are `ratio` on the
    background. At the sources they are `ratio` too if counts are in a wrong unit; 1 + (ratio - 1) b
    / mu if a variance is missing (read noise) or too much (a pedestal); 1 + (ratio - 1) mu / b if
    the noise is a share of the counts. The fainter half of the sources decides, for misfits of
    another kind grow with the flux.
    """
    noise, mean, level = context.posterior.noise.pixelwise, context.expected, context.level
    if not isinstance(noise, PoissonNoise):
        return _finding_of_noise(context, "over-dispersion", ratio, np.ones(1))
    mu = noise.counts_variance(mean, level)
    b = np.maximum(noise.counts_variance(np.full_like(mean, level), level), 1e-9)
    lit = context.used & (context.distance <= 1.5 * context.light.width) & (mu > 1.5 * b)
    matched = context.light.matched[context.owner] & lit
    power = context.power[context.owner]
    names = ["gain", "read noise" if ratio > 1.0 else "pedestal"]
    growth = [np.ones(1), b / np.maximum(mu, 1e-9)]
    if ratio > 1.0:
        names, growth = [*names, "over-dispersion"], [*growth, np.minimum(mu / b, STEEPEST)]
    if not matched.any():
        return _finding_of_noise(context, names[0], ratio, growth[0])
    fainter = matched & (power <= np.median(power[matched]))
    seen = np.log(max(float(np.mean(context.z[fainter] ** 2)), 1e-9))
    predicted = [
        np.log(
            max(float(np.mean(1.0 + (ratio - 1.0) * np.broadcast_to(g, mu.shape)[fainter])), 0.01)
        )
        for g in growth
    ]
    best = int(np.argmin(np.abs(np.array(predicted) - seen)))
    return _finding_of_noise(context, names[best], ratio, growth[best])


def _finding_of_noise(context: Context, name: str, ratio: float, growth: Floats) -> Finding:
    part = np.broadcast_to(growth, context.expected.shape)[context.used]
    explained = abs(ratio - 1.0) * float(np.sum(part))
    base = max(context.level, 0.0)
    found = (
        f"between the sources the counts scatter with {ratio:.3g} times the variance of the noise "
        f"model at {base:.3g} counts a pixel"
    )
    variance = abs(ratio - 1.0) * float(np.median(context.variance[context.used]))
    if name == "gain":
        unit = "less" if ratio < 1.0 else "more"
        sentence = f"{found}, and at the sources, too: one count is {unit} than one photon"
        remedy = f"check frame.gain: {1.0 / ratio:.3g} times the present one would cure it"
    elif name == "read noise":
        sentence = f"{found}, and at bright sources with less: some variance is constant"
        known = float(np.median(getattr(context.posterior.noise.pixelwise, "read_noise", 0.0)))
        remedy = f"set noise.read_noise to about {math.hypot(variance**0.5, known):.3g}"
    elif name == "pedestal":
        sentence = f"{found}, and at bright sources with more: {variance:.3g} counts are no photons"
        remedy = f"check frame.pedestal, {variance:.3g} counts more, or a smaller read_noise"
    else:
        sentence = f"{found}, and at bright sources with more: the noise is not the photons' alone"
        remedy = "check the flat field and the variance of the noise model"
    return Finding(Cause(name, 0.0, sentence, remedy), explained, "noise")

"""Images of sources: the kernel summed over the pixels that they reach.

On a row of pixels a^2 + b^2 and D are polynomials in u alone: a sample of a Gaussian's kernel costs
two Horner sweeps and one exponential.
"""

from bayesfred.imaging.kernels.compilation import entry, shared
from bayesfred.imaging.kernels.contexts import Canvas
from bayesfred.imaging.kernels.fastmath import FAST, wide_vectors
from bayesfred.imaging.kernels.geometry import (
    lay_out,
    locate,
    new_geometry,
    one_source,
    row_starts,
    some_sources,
)
from bayesfred.imaging.kernels.polynomials import map_on_row, polynomial_on_row
from bayesfred.imaging.kernels.products import (
    add_product,
    add_product_templates,
    by_image,
)
from bayesfred.imaging.kernels.psf_dispatch import (
    fill_psf_row,
    find_places,
    psf_of_source,
    psf_on_row,
    psf_slopes,
    rows_at_once,
)

# sources whose rows are listed at a time: of many sources the list would outgrow the caches
BATCH = 32


@shared(_nrt=False, fastmath=FAST)
def _add_samples(layout, s, rows, flux, canvas, alone):
    # What the rows share is taken out of the tuples once, and the loop over pixels stays in this
    # function: a call costs more than a short row. It counts no references: threads count those to
    # what they share in turn.
    wide_vectors()
    o, fp, sigma, work = layout.optics, layout.footprints, layout.sigma, layout.work
    source, places = one_source(layout.geometry, s), layout.places
    psf = psf_of_source(o.psf, source.number)
    d, u, v = source.d, source.u, source.v
    offsets, weights, step = o.offsets, o.weights, o.step
    lows, js, sizes = fp.low, fp.row, fp.size
    out, at = canvas.image, canvas.at
    middle_u, middle_v = 0.5 * (o.nx - 1), 0.5 * (o.ny - 1)
    rd, ramp, degrees = work[1], o.ramp, o.degrees
    d_top = len(degrees.d)
    norm = flux * psf.norm / (sigma * sigma)
    for i in range(rows[0], rows[1]):
        w = (js[i] - middle_v) * step - v
        t_low = (lows[i] - middle_u) * step - u
        row = out[at[i] : at[i] + sizes[i]]
        stamp = None if alone is None else alone.image[alone.at[i] : alone.at[i] + sizes[i]]
        for y in range(offsets.size):
            fill_psf_row(psf, source, w + offsets[y], sigma, work, degrees)
            for x in range(offsets.size):
                polynomial_on_row(d, w + offsets[y], norm * weights[y] * weights[x], rd, degrees.d)
                t0 = t_low + offsets[x]
                find_places(psf, (t0, ramp, row.size), work, degrees, places)
                for n in range(row.size):
                    t = t0 + ramp[n]
                    j = rd[d_top]
                    for m in range(d_top):
                        j = j * t + rd[d_top - 1 - m]
                    value = psf_on_row(psf, t, n, work, degrees, places) * abs(j)
                    row[n] += value
                    if alone is not None:
                        stamp[n] = value + (stamp[n] if x + y > 0 else 0.0)


def _add_by_samples(layout, s, rows, flux, canvas, alone):
    _add_samples(layout, s, rows, flux, canvas, alone)


def _add_by_product(layout, s, rows, flux, canvas, alone):
    add_product(layout, s, rows, flux, canvas, alone)


# Add the rows of source s from rows[0] to rows[1], times its flux, to a canvas. `alone` is None or
# a canvas where the source alone is left.
add_source = by_image(_add_by_product, _add_by_samples)


@shared(_nrt=False, fastmath=FAST)
def _add_sample_templates(layout, s, flux, stamps, wider):
    o, fp, sigma, work = layout.optics, layout.footprints, layout.sigma, layout.work
    source = one_source(layout.geometry, s)
    offsets, weights, step, ramp = o.offsets, o.weights, o.step, o.ramp
    rd, ra, rb = work[1], work[2], work[3]
    psf, degrees = psf_of_source(o.psf, source.number), o.degrees
    d_top, top, inverse = len(degrees.d), len(degrees.ab), 1.0 / sigma
    for i in range(fp.first[s], fp.first[s + 1]):
        w = (fp.row[i] - 0.5 * (o.ny - 1)) * step - source.v
        t_low = (fp.low[i] - 0.5 * (o.nx - 1)) * step - source.u
        first, last = fp.start[i], fp.start[i + 1]
        row, row_a, row_b = stamps[0, first:last], stamps[1, first:last], stamps[2, first:last]
        row_s = None if wider is None else wider[first:last]
        for y in range(offsets.size):
            map_on_row(source, w + offsets[y], work, degrees.ab)
            for x in range(offsets.size):
                weight = weights[y] * weights[x] * psf.norm / (sigma * sigma)
                polynomial_on_row(source.d, w + offsets[y], weight, rd, degrees.d)
                t0 = t_low + offsets[x]
                for n in range(row.size):
                    t = t0 + ramp[n]
                    j = rd[d_top]
                    for m in range(d_top):
                        j = j * t + rd[d_top - 1 - m]
                    a, b = ra[top], rb[top]
                    for m in range(top):
                        a = a * t + ra[top - 1 - m]
                        b = b * t + rb[top - 1 - m]
                    k, k_a, k_b = psf_slopes(psf, inverse * a, inverse * b)
                    row[n] += k * abs(j)
                    row_a[n] += flux * inverse * k_a * abs(j)
                    row_b[n] += flux * inverse * k_b * abs(j)
                    if wider is not None:
                        row_s[n] += flux * (inverse * (a * k_a + b * k_b) - 2.0 * k) * abs(j)


def _templates_by_samples(layout, s, flux, stamps, wider):
    _add_sample_templates(layout, s, flux, stamps, wider)


def _templates_by_product(layout, s, flux, stamps, wider):
    add_product_templates(layout, s, flux, stamps, wider)


# Add K, F X and F Y of source s to its rows of `stamps`, shape (3, samples). X = -p_a |D| is K's
# derivative as the source moves along a, Y along b. `wider` is None or where F dK/dln(sigma) is
# added, F (a X + b Y - 2 K) because p is homogeneous of degree -2 in a, b and sigma.
add_templates = by_image(_templates_by_product, _templates_by_samples)


@shared(_nrt=False)
def add_sources(layout, flux, canvas):
    """Add sources to a canvas, some rows of each at a time.

    So what these look up of a PSF is in the caches after the first source.
    """
    first, top, is_done = layout.footprints.first, 0, False
    band = rows_at_once(layout.optics.psf)
    while not is_done:
        is_done = True
        for s in range(flux.size):
            rows = first[s] + top, min(first[s] + top + band, first[s + 1])
            if rows[0] < rows[1]:
                add_source(layout, s, rows, flux[s], canvas, None)
                is_done = is_done and rows[1] == first[s + 1]
        top += band


@entry()
def render(o, theta, nuisances, flux, out):
    """Add all sources to the padded, flattened image `out`; False where a source's map folds."""
    geometry = new_geometry(o)
    unfolded = locate(o, theta, nuisances, geometry)
    for s in range(0, flux.size, BATCH):
        part = some_sources(geometry, s, s + BATCH)
        layout = lay_out(o, part, nuisances.psf_sigma)
        fp = layout.footprints
        canvas = Canvas(out, row_starts(fp, out.size // o.ny))
        add_sources(layout, flux[s : s + BATCH], canvas)
    return unfolded

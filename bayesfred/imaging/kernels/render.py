"""Images of sources: the kernel summed over the pixels that they reach.

On a row of pixels a^2 + b^2 and D are polynomials in u alone: a sample of a Gaussian's kernel costs
two Horner sweeps and one exponential.
"""

from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST
from bayesfred.imaging.kernels.geometry import (
    Maps,
    footprints,
    locate,
    new_maps,
    new_work,
    row_starts,
)
from bayesfred.imaging.kernels.polynomials import map_on_row, polynomial_on_row
from bayesfred.imaging.kernels.psf_profiles import psf_arguments, psf_slopes, psf_value

BATCH = (
    32  # sources whose rows are listed at a time: of many sources the list would outgrow the caches
)


@inner(fastmath=FAST, error_model="numpy")
def add_source(o, maps, fp, s, first, last, sigma, flux, at, out, work, place, stamps):
    """Add the rows of source s from `first` to `last` to `out`, the samples of row i from at[i] on.

    With `stamps` the source alone is left there, row i from place[i] on.
    """
    # What the rows share is taken out of the tuples once, and the loop over pixels stays in this
    # function: a call costs more than a short row.
    d, u, v = maps.d[s], maps.peak[s, 0], maps.peak[s, 1]
    offsets, weights, step, lows, rows, sizes = (
        o.offsets,
        o.weights,
        o.step,
        fp.low,
        fp.row,
        fp.size,
    )
    middle_u, middle_v = 0.5 * (o.nx - 1), 0.5 * (o.ny - 1)
    r, rd, r2, ramp, psf = work[0], work[1], work[2], o.ramp, o.psf
    d_top = len(o.d_degree)
    norm = flux * psf.norm / (sigma * sigma)
    for i in range(first, last):
        w = (rows[i] - middle_v) * step - v
        t_low = (lows[i] - middle_u) * step - u
        row = out[at[i] : at[i] + sizes[i]]
        stamp = None if stamps is None else stamps[place[i] : place[i] + sizes[i]]
        for y in range(offsets.size):
            psf_arguments(psf, maps, s, w + offsets[y], sigma, work, o.degree, o.q_degree)
            for x in range(offsets.size):
                polynomial_on_row(d, w + offsets[y], norm * weights[y] * weights[x], rd, o.d_degree)
                t0 = t_low + offsets[x]
                for n in range(row.size):
                    t = t0 + ramp[n]
                    j = rd[d_top]
                    for m in range(d_top):
                        j = j * t + rd[d_top - 1 - m]
                    value = psf_value(psf, t, r, r2, o.degree, o.q_degree) * abs(j)
                    row[n] += value
                    if stamps is not None:
                        stamp[n] = value + (stamp[n] if x + y > 0 else 0.0)


@inner(fastmath=FAST, error_model="numpy")
def add_templates(o, maps, fp, s, sigma, flux, image, along, across, work):
    """Like `add_source` at unit flux, and F X and F Y beside it: X = -p_a |D| is K's derivative as s moves along a."""
    u, v = maps.peak[s, 0], maps.peak[s, 1]
    offsets, weights, step, ramp = o.offsets, o.weights, o.step, o.ramp
    rd, ra, rb, rav, rbv = work[1], work[2], work[3], work[4], work[5]
    d_top, top = len(o.d_degree), len(o.degree)
    for i in range(fp.first[s], fp.first[s + 1]):
        w = (fp.row[i] - 0.5 * (o.ny - 1)) * step - v
        t_low = (fp.low[i] - 0.5 * (o.nx - 1)) * step - u
        first, last = fp.start[i], fp.start[i + 1]
        row, row_a, row_b = image[first:last], along[first:last], across[first:last]
        for y in range(offsets.size):
            map_on_row(maps.a[s], maps.b[s], w + offsets[y], ra, rb, rav, rbv, o.degree)
            for x in range(offsets.size):
                weight = weights[y] * weights[x] * o.psf.norm / (sigma * sigma)
                polynomial_on_row(maps.d[s], w + offsets[y], weight, rd, o.d_degree)
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
                    k, k_a, k_b = psf_slopes(o.psf, sigma, a, b)
                    row[n] += k * abs(j)
                    row_a[n] += flux * k_a * abs(j)
                    row_b[n] += flux * k_b * abs(j)


@entry()
def image(o, theta, offset_x, offset_y, sigma, flux, out):
    """Add all sources to the padded, flattened image `out`. Returns False where a source's map folds."""
    maps = new_maps(o)
    work = new_work(o)
    unfolded = locate(o, theta, offset_x, offset_y, sigma, 0.0, maps)
    for s in range(0, flux.size, BATCH):
        e = s + BATCH
        a, b, q, d = maps.a[s:e], maps.b[s:e], maps.q[s:e], maps.d[s:e]
        part = Maps(a, b, q, d, maps.peak[s:e], maps.ellipse[s:e], maps.rows[s:e])
        fp = footprints(o, part)
        at = row_starts(fp, out.size // o.ny)
        for i in range(part.peak.shape[0]):
            add_source(
                o,
                part,
                fp,
                i,
                fp.first[i],
                fp.first[i + 1],
                sigma,
                flux[s + i],
                at,
                out,
                work,
                None,
                None,
            )
    return unfolded

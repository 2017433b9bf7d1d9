"""Images of sources: the kernel summed over the pixels that they reach.

On a row of pixels a^2 + b^2 and D are polynomials in u alone: a sample of a Gaussian's kernel costs
two Horner sweeps and one exponential.
"""

from bayesfred.imaging.kernels.compilation import entry, inner, leaf, shared
from bayesfred.imaging.kernels.contexts import LANES, Canvas
from bayesfred.imaging.kernels.fastmath import FAST
from bayesfred.imaging.kernels.geometry import (
    find_patch,
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
    lines_of,
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


@leaf(fastmath=FAST, error_model="numpy")
def _add_samples(layout, psf, t0, row):
    """Add a row's samples from t0 on, as `layout.work` describes them, times the norm in them."""
    o, work, places = layout.optics, layout.work, layout.places
    ramp, degrees = o.ramp, o.degrees
    rd, d_top = work[1], len(degrees.d)
    find_places(psf, (t0, ramp, row.size), work, degrees.ab, places)
    for n in range(row.size):
        t = t0 + ramp[n]
        j = rd[d_top]
        for m in range(d_top):
            j = j * t + rd[d_top - 1 - m]
        row[n] += psf_on_row(psf, t, n, work, degrees, places) * abs(j)


@leaf(fastmath=FAST, error_model="numpy")
def _add_rows(layout, source, psf, rows_and_flux, canvas):
    """Add rows of a source whose image is no product, of pixels that share no samples."""
    o, fp, sigma, work = layout.optics, layout.footprints, layout.sigma, layout.work
    (rows, flux), d, u, v = rows_and_flux, source.d, source.u, source.v
    offsets, weights, step = o.rule.offsets, o.rule.weights[0], o.step
    lows, js, sizes = fp.low, fp.row, fp.size
    out, at, degrees = canvas.image, canvas.at, o.degrees
    middle_u, middle_v = 0.5 * (o.nx - 1), 0.5 * (o.ny - 1)
    norm = flux * psf.norm / (sigma * sigma)
    for i in range(rows[0], rows[1]):
        w = (js[i] - middle_v) * step - v
        t_low = (lows[i] - middle_u) * step - u
        row = out[at[i] : at[i] + sizes[i]]
        for y in range(offsets.size):
            fill_psf_row(psf, source, w + offsets[y], sigma, work, degrees)
            for x in range(offsets.size):
                weight = norm * weights[y] * weights[x]
                polynomial_on_row(d, w + offsets[y], weight, work[1], degrees.d)
                _add_samples(layout, psf, t_low + offsets[x], row)


@leaf(fastmath=FAST, error_model="numpy")
def _sample_patch(layout, source, psf, patch, flux, samples):
    """Fill samples with those at the points (offsets[x], offsets[y]) of all pixels, x fastest."""
    o, fp, sigma, work = layout.optics, layout.footprints, layout.sigma, layout.work
    (every, rows, left, pitch), step, degrees = patch, o.step, o.degrees
    offsets, reach = o.rule.offsets, o.rule.weights.shape[0] // 2
    norm, m = flux * psf.norm / (sigma * sigma), offsets.size
    size = (rows[1] - rows[0] + 2 * reach) * pitch + 2 * LANES
    samples[: m * m * size] = 0.0
    for i in range(rows[0] - reach, rows[1] + reach):
        k = min(max(i, every[0]), every[1] - 1)
        j, low, high = fp.row[k] + i - k, fp.low[k], fp.low[k] + fp.size[k]
        if i != k and 0 <= j < o.ny:
            continue  # too faint
        low -= LANES if low == 0 else 0
        high += LANES if high >= o.nx else 0
        w = (j - 0.5 * (o.ny - 1)) * step - source.v
        t = (low - 0.5 * (o.nx - 1)) * step - source.u
        begin = LANES + (i - rows[0] + reach) * pitch + low - left
        for y in range(m):
            fill_psf_row(psf, source, w + offsets[y], sigma, work, degrees)
            polynomial_on_row(source.d, w + offsets[y], norm, work[1], degrees.d)
            for x in range(m):
                first = (y * m + x) * size + begin
                # a row that reaches both borders may be longer than the ramp
                for a in range(0, high - low, o.ramp.size):
                    row = samples[first + a : first + min(a + o.ramp.size, high - low)]
                    _add_samples(layout, psf, t + offsets[x] + a * step, row)


@leaf(fastmath=FAST)
def _add_filtered(samples, weights, pitch, out):
    """out[n] += the sum of weights[k] samples[n + k pitch]."""
    # slices, because an index that is a sum might be negative, which is looked at
    a, b, c = weights[0], weights[1], weights[2]
    first, second, third = samples, samples[pitch:], samples[2 * pitch :]
    if weights.size == 3:
        for n in range(out.size):
            out[n] += a * first[n] + b * second[n] + c * third[n]
    else:
        d, e = weights[3], weights[4]
        fourth, fifth = samples[3 * pitch :], samples[4 * pitch :]
        for n in range(out.size):
            out[n] += a * first[n] + b * second[n] + c * third[n] + d * fourth[n] + e * fifth[n]


@leaf(fastmath=FAST)
def _add_shared(layout, source, psf, patch, flux, canvas):
    """Add the rows of a source, of pixels that share samples: see `imaging/pixel_rules`."""
    weights, (_, rows, _, pitch) = layout.optics.rule.weights, patch
    reach, m, buffer = weights.shape[0] // 2, weights.shape[1], layout.patch
    size = (rows[1] - rows[0]) * pitch
    light, column = buffer[:size], buffer[size : 2 * size + 2 * LANES]
    samples = buffer[2 * (size + LANES) :]
    _sample_patch(layout, source, psf, patch, flux, samples)
    light[:] = 0.0
    for x in range(m):
        column[:] = 0.0
        for y in range(m):
            own = samples[(y * m + x) * (size + 2 * (reach * pitch + LANES)) :]
            _add_filtered(own, weights[:, y], pitch, column)
        _add_filtered(column[LANES - reach :], weights[:, x], 1, light)
    _add_patch(layout.footprints, patch, light, canvas)


@leaf(fastmath=FAST)
def _add_run(values, out):
    for n in range(out.size):
        out[n] += values[n]


@leaf(fastmath=FAST)
def _add_patch(fp, patch, light, canvas):
    """Add a patch to a canvas."""
    _, rows, left, pitch = patch
    at, lows, sizes = canvas.at, fp.low, fp.size
    for i in range(rows[0], rows[1]):
        own = light[(i - rows[0]) * pitch + lows[i] - left :]
        _add_run(own, canvas.image[at[i] : at[i] + sizes[i]])


@leaf(fastmath=FAST)
def _clear_rows(sizes, rows, canvas):
    for i in range(rows[0], rows[1]):
        canvas.image[canvas.at[i] : canvas.at[i] + sizes[i]] = 0.0


@leaf(fastmath=FAST)
def _add_canvas(sizes, rows, alone, canvas):
    """Add rows of one canvas to another."""
    for i in range(rows[0], rows[1]):
        begin = canvas.at[i]
        _add_run(alone.image[alone.at[i] :], canvas.image[begin : begin + sizes[i]])


@leaf(fastmath=FAST, error_model="numpy")
def _add_image(shares, layout, s, rows, flux, canvas):
    """Add rows of a source whose image is no product."""
    o, fp = layout.optics, layout.footprints
    source = one_source(layout.geometry, s)
    psf = psf_of_source(o.psf, source.number)
    if shares is None:
        _add_rows(layout, source, psf, (rows, flux), canvas)
    else:
        _add_shared(layout, source, psf, find_patch(o, fp, s, rows), flux, canvas)


@inner()
def _add_if_product(translates, layout, s_and_flux, rows, canvas, alone):
    if translates is None:
        return False
    (s, flux), fp = s_and_flux, layout.footprints
    lines = lines_of(translates, layout.optics.psf, layout, s, rows[0], rows[1])
    return add_product(lines, fp, rows, flux, canvas, alone)


@shared(_nrt=False, fastmath=FAST, error_model="numpy")
def add_source(layout, s, rows, flux, canvas, alone):
    """Add the rows of source s from rows[0] to rows[1], times its flux, to a canvas.

    `alone` is None or a canvas where the source alone is left.
    """
    o, sizes = layout.optics, layout.footprints.size
    translates, shares = o.translates, o.rule.shares
    if rows[0] >= rows[1] or _add_if_product(translates, layout, (s, flux), rows, canvas, alone):
        return
    if alone is None:
        _add_image(shares, layout, s, rows, flux, canvas)
    else:
        _clear_rows(sizes, rows, alone)
        _add_image(shares, layout, s, rows, flux, alone)
        _add_canvas(sizes, rows, alone, canvas)


@shared(fastmath=FAST, error_model="numpy")
def add_templates(layout, s, flux, stamps, wider):
    """Add K, F X and F Y of source s to its rows of `stamps`, shape (3, samples).

    X = -p_a |D| is K's derivative as the source moves along a, Y along b. `wider` is None or where
    F dK/dln(sigma) is added, F (a X + b Y - 2 K) because p is homogeneous of degree -2 in a, b and
    sigma.
    """
    o, fp, sigma, work = layout.optics, layout.footprints, layout.sigma, layout.work
    lines = lines_of(o.translates, o.psf, layout, s, fp.first[s], fp.first[s + 1])
    if add_product_templates(lines, fp, s, flux, stamps, wider):
        return
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


@shared()
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

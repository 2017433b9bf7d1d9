"""Sources rendered and compared with a frame: the log-likelihood of parameter vectors."""

import math

import numpy as np

from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.contexts import Canvas
from bayesfred.imaging.kernels.fastmath import take_turn
from bayesfred.imaging.kernels.geometry import (
    find_footprints,
    layout_of,
    locate,
    new_geometry,
    row_starts,
)
from bayesfred.imaging.kernels.render import add_sources
from bayesfred.model.kernels.clusters import bounding_boxes, find_clusters
from bayesfred.model.kernels.contexts import Known, Profiled, Rendered, Touching, parameters_of
from bayesfred.model.kernels.extrapolate import profile_extrapolated
from bayesfred.model.kernels.fluxes import profile
from bayesfred.model.kernels.likelihood import clear, counted, log_likelihood, mark, room


@inner()
def _fill_image(problem, layout, w, parameters, known, free):
    """Add the sources to the image, their fluxes at their maximum if they are free.

    Returns what profiling adds to the log-likelihood, the fluxes, and what the derivatives need.
    """
    o, fp, fluxes = layout.optics, layout.footprints, np.empty(problem.flux.size)
    if free is None:
        canvas = Canvas(w.image, row_starts(fp, w.image.size // o.ny))
        for s in range(fluxes.size):
            fluxes[s] = parameters.nuisances.flux_scale * problem.flux[s]
        add_sources(layout, fluxes, canvas)
        return 0.0, fluxes, None
    templates = 3 if parameters.nuisances.position_scatter > 0.0 else 1
    boxes = bounding_boxes(fp)
    clusters = find_clusters(boxes, o.ny, templates)
    stamps = room(w, w.image.size, templates * fp.start[fp.row.size]).reshape(templates, -1)
    touching = Touching(fp, boxes, clusters, stamps, problem.faint, problem.scatters)
    factors, shifts = np.empty(clusters.begin[-1]), np.zeros((fluxes.size, 2))
    profiled = Profiled(touching, factors, fluxes, shifts, problem.shape)
    return profile(problem, layout, w, parameters, known, profiled), fluxes, profiled


@entry()
def render(problem, w, parameters, known, whole):
    """Render all sources, profiling their fluxes if they are free.

    On all pixels, or on no more than the likelihood needs. The caller clears the workspace.
    """
    o, nuisances = problem.optics, parameters.nuisances
    geometry = new_geometry(o)
    extra = 0.0
    if not (nuisances.position_scatter >= 0.0 and locate(o, parameters.theta, nuisances, geometry)):
        extra = -math.inf
        geometry.rows[:] = 0
    fp = find_footprints(o, geometry) if whole else counted(problem.frame, o, geometry)
    layout = layout_of(o, geometry, fp, nuisances.psf_sigma)
    mark(problem.frame, layout.footprints, w)
    more, fluxes, profiled = _fill_image(problem, layout, w, parameters, known, problem.free)
    return Rendered(extra + more, geometry, layout.footprints, fluxes, profiled)


@inner()
def _keep(fluxes, profiled, out):
    """Keep fluxes and shifts."""
    for s in range(fluxes.size):  # to assign arrays would compile messages about their shapes
        out[s, 0] = fluxes[s]
        if profiled is not None:
            out[s, 1], out[s, 2] = profiled.shifts[s]


@entry()
def log_likelihoods(problem, w, vectors, turns):
    """Log-likelihoods of rows into turns.values; rows where it is -inf or NaN are left alone.

    Each row is whose turn it is: threads that share `turns` share the rows, and one that is held up
    takes fewer.
    """
    out = turns.values
    while True:
        i = take_turn(turns.turn)
        if i >= out.size:
            break
        if out[i] > -math.inf:
            parameters = parameters_of(vectors, i)
            known = Known(turns.start[i], turns.nearby)
            rendered = render(problem, w, parameters, known, False)
            value = rendered.extra
            if value > -math.inf:
                value += log_likelihood(problem.frame, w, parameters)
            clear(w)
            out[i] = value
            if turns.found.size > 0:
                _keep(rendered.fluxes, rendered.profiled, turns.found[i])


@entry()
def extrapolated_log_likelihoods(problem, w, vectors, turns, extrapolated):
    """The same by `extrapolate.py`; NaN where that does not serve.

    A function of its own, so that neither is compiled for the other's sake.
    """
    out = turns.values
    while True:
        i = take_turn(turns.turn)
        if i >= out.size:
            break
        if out[i] > -math.inf:
            fluxes = extrapolated.fluxes[i].copy()
            parameters = parameters_of(vectors, i)
            out[i] = profile_extrapolated(problem, w, parameters, fluxes, extrapolated)
            clear(w)

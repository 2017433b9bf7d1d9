"""What a PSF's nodes have in common and its constant can have as well: which of them has how much.

The grid of the nodes is twice as coarse as the constant's fine one, whose splines its own are exact
sums of. So the same coefficients x can be added at every node and taken from the constant, and the
PSF is what it was. The counts say nothing of x. The priors do: with B x the coefficients on the
fine grid, c those of the constant, d_n those of the nodes, and P and Q the precisions of the two
priors, x minimises

    (c - B x)^T P (c - B x) / 2 + sum_n (d_n + x)^T Q (d_n + x) / 2.

Turns that solve for the constant and for the nodes one after another move x by the share that the
priors have of the information, which is next to nothing, and would not end.
"""

from dataclasses import replace

import numpy as np
from scipy import linalg, sparse

from bayesfred._typing import Flags
from bayesfred.model.kernels.psf_normal import halved
from bayesfred.optimize.psf_equations import PsfState

__all__ = ["split"]


def split(state: PsfState) -> PsfState:
    """The state with the same PSF whose parts are the most likely ones.

    Parameters
    ----------
    state : PsfState
        With nodes.

    Returns
    -------
    PsfState
    """
    grid, nodes = state.grid, state.nodes
    assert nodes is not None, "the PSF varies between them"
    side, own, conventions = grid.at_nodes
    each, fine = nodes.coefficients.reshape(-1, side**2), grid.blocks[0]
    finer, inside = _shared_splines(side, int(grid.unknown.side[0]))
    p = state.strengths[0] * fine.roughness + sparse.diags_array(fine.amplitude)
    q = nodes.strength * (own.roughness.toarray() + np.diag(own.amplitude))
    constant, common = state.deviations[fine.where], each.sum(axis=0)
    precision = (finer.T @ p @ finer).toarray() + len(each) * q[np.ix_(inside, inside)]
    pull = finer.T @ (p @ constant) - q[inside] @ common
    free = linalg.null_space(conventions[:, inside])  # volume and centroid stay
    x = free @ linalg.solve(free.T @ precision @ free, free.T @ pull, assume_a="pos")
    deviations, every = state.deviations.copy(), each.copy()
    deviations[fine.where] -= finer @ x
    every[:, inside] += x
    moved = replace(nodes, coefficients=every.reshape(nodes.coefficients.shape))
    return replace(state, coefficients=state.deviating(deviations), nodes=moved)


def _shared_splines(side: int, fine_side: int) -> tuple[sparse.csr_array, Flags]:
    """Splines of the nodes' grid as sums of the fine ones, a column each, and which these are.

    Those at the edge, which reach beyond the fine grid, are left out.
    """
    finer = halved(side)
    edge = (len(finer) - fine_side) // 2
    within = finer[edge : edge + fine_side]
    inside = np.abs(within).sum(axis=0) == finer.sum(axis=0)
    part = within[:, inside]
    return sparse.csr_array(np.kron(part, part)), np.outer(inside, inside).ravel()

"""The Cholesky factor of a cluster's matrix H, and what is solved with it.

Row i of H, and of its factor L, is kept from column lead[i] to the diagonal, its element in column
k at start[i] + k. Of many sources that touch their neighbours alone, most of these elements of L
are products of many small numbers. So those that are negligible are zero, and sums leave them out:
of 1,925 sources they are 15 in 16. Numbers that small would become denormal in the end, too, with
which arithmetic is slow.
"""

import math

import numpy as np

from bayesfred.imaging.kernels.compilation import leaf, shared
from bayesfred.imaging.kernels.fastmath import REDUCE

NEGLIGIBLE = 1e-20  # of an element of L beside the square root of its row's in H's diagonal
U = np.uint64


@leaf(fastmath=REDUCE)
def inner_product(a, b):
    """Sum of a[i] b[i]."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@leaf()
def _sum_blocks(h, rows, columns, width, blocks):
    """The inner product of two rows of h between two columns, where `blocks` has bits.

    A bit stands for the columns of a block, `width` of them, its number modulo 64 the bit's. The
    rows are told by where their column 0 would be.
    """
    (a, b), (first, last), total = rows, columns, 0.0
    n = first // width
    turn = U(n) & U(63)
    blocks = (blocks >> turn) | (blocks << (U(64) - turn & U(63)))
    while blocks != U(0):
        begin = n
        while blocks & U(1) != U(0):
            blocks >>= U(1)
            n += 1
        low, high = max(begin * width, first), min(n * width, last)
        if low < high:
            total += inner_product(h[a + low : a + high], h[b + low : b + high])
        blocks >>= U(1)
        n += 1
    return total


@shared()
def cholesky(h, group):
    """Lower triangle in place; False where the matrix is not positive definite."""
    lead, start, widest = group.lead, group.start, 0
    for i in range(lead.size):
        widest = max(widest, i - lead[i])
    width = 8 * (1 + widest // 480)  # so that a row lies in less than 64 blocks
    blocks = np.zeros(lead.size, np.uint64)  # those of each row with elements other than zero
    for i in range(lead.size):
        at = start[i]
        least = NEGLIGIBLE * math.sqrt(max(h[at + i], 0.0))
        for k in range(lead[i], i + 1):
            columns, common = (max(lead[i], lead[k]), k), blocks[i] & blocks[k]
            total = h[at + k] - _sum_blocks(h, (at, start[k]), columns, width, common)
            if i == k:
                if not total > 0.0:
                    return False
                h[at + i] = math.sqrt(total)
            elif abs(total) > least * h[start[k] + k]:
                h[at + k] = total / h[start[k] + k]
                blocks[i] |= U(1) << (U(k // width) & U(63))
            else:
                h[at + k] = 0.0
    return True


@shared(_nrt=False)
def solve(lower, group, x):
    """x <- (L L^T)^-1 x, in place."""
    lead, start = group.lead, group.start
    for i in range(x.size):
        at = start[i]
        x[i] = (x[i] - inner_product(lower[at + lead[i] : at + i], x[lead[i] : i])) / lower[at + i]
    for i in range(x.size - 1, -1, -1):
        at = start[i]
        x[i] /= lower[at + i]
        for m in range(lead[i], i):
            x[m] -= lower[at + m] * x[i]


@leaf(fastmath=REDUCE)
def _times_row(row, factor, x, out):
    """Add factor times a row to out, and return the row's product with x."""
    total = 0.0
    for i in range(row.size):
        total += row[i] * x[i]
        out[i] += factor * row[i]
    return total


@shared()
def invert(lower, group):
    """(L L^T)^-1 where L has elements other than zero, stored as L is.

    Those elsewhere are not needed for these, and are zero here.

    References
    ----------
    K. Takahashi, J. Fagan & M.-S. Chin, 8th PICA Conference (1973): Q L is the upper triangle
    L^-T, whose diagonal is known, and tells the columns of Q from the last to the first.
    """
    lead, start, size = group.lead, group.start, group.lead.size
    out, ends = np.zeros(lower.size), np.zeros(size, np.int64)
    for i in range(size):
        ends[lead[i]] = i + 1  # of a column, where only earlier ones end later, too
    column, found = np.zeros(size), np.zeros(size)
    begins, stops = np.empty(size, np.int64), np.empty(size, np.int64)
    for j in range(1, size):
        ends[j] = max(ends[j], ends[j - 1])
    for j in range(size - 1, -1, -1):
        runs = 0  # of elements of the column other than zero
        for i in range(j + 1, ends[j]):
            column[i] = lower[start[i] + j] if lead[i] <= j else 0.0
            if column[i] != 0.0:
                found[i] = 0.0
                if runs == 0 or stops[runs - 1] < i:
                    begins[runs] = i
                    runs += 1
                stops[runs - 1] = i + 1
        pivot = 1.0 / lower[start[j] + j]
        for n in range(runs):
            for i in range(begins[n], stops[n]):
                for m in range(n + 1):
                    within = slice(begins[m], min(stops[m], i))
                    row = out[start[i] + within.start : start[i] + within.stop]
                    found[i] += _times_row(row, column[i], column[within], found[within])
                found[i] += out[start[i] + i] * column[i]
        own = pivot
        for n in range(runs):
            for i in range(begins[n], stops[n]):
                out[start[i] + j] = -found[i] * pivot
                own += found[i] * pivot * column[i]
        out[start[j] + j] = own * pivot
    return out

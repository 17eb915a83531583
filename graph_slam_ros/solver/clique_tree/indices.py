"""Arrays of indices: sorted, joined, lengthened.

NumPy's own functions would do. But Numba compiles each form of ``np.sort``, ``np.argsort`` and ``np.concatenate`` that
a kernel uses with that kernel, and takes several seconds for them.
"""

import numpy as np

from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.typing import Index

RUN = 16  # numbers that are sorted by insertion


@kernel
def ascending(numbers: Index) -> Index:
    """Return the indices that sort some numbers; equal ones keep their order. Short runs are merged."""
    n, width = len(numbers), RUN
    order = np.empty(n, np.int64)
    merged = np.empty(n, np.int64) if n > width else order
    for low in range(0, n, width):
        for k in range(low, min(low + width, n)):
            i = k
            while i > low and numbers[order[i - 1]] > numbers[k]:
                order[i] = order[i - 1]
                i -= 1
            order[i] = k
    while width < n:
        for low in range(0, n, 2 * width):
            middle, high = min(low + width, n), min(low + 2 * width, n)
            i, j = low, middle
            for k in range(low, high):
                if i < middle and (j == high or numbers[order[i]] <= numbers[order[j]]):
                    merged[k] = order[i]
                    i += 1
                else:
                    merged[k] = order[j]
                    j += 1
        order, merged = merged, order
        width *= 2
    return order


@kernel
def in_order(numbers: Index) -> Index:
    """Return the numbers in ascending order."""
    return chosen(numbers, ascending(numbers))


@kernel
def chosen(numbers: Index, places: Index) -> Index:
    """Return the numbers at some indices."""
    out = np.empty(len(places), np.int64)
    for k in range(len(places)):
        out[k] = numbers[places[k]]
    return out


@kernel
def joined(first: Index, then: Index) -> Index:
    """Return two arrays joined into one."""
    out = np.empty(len(first) + len(then), np.int64)
    for k in range(len(first)):
        out[k] = first[k]
    for k in range(len(then)):
        out[len(first) + k] = then[k]
    return out


@kernel
def lengthened(numbers: Index, count: int) -> Index:
    """Return the numbers followed by free room for more."""
    out = np.empty(len(numbers) + count, np.int64)
    for k in range(len(numbers)):
        out[k] = numbers[k]
    return out

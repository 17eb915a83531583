"""Thinning of published paths: the thinned path changes as little as possible while it grows."""

import numpy as np

from graph_slam_ros.typing import Array, Index


def thinned(count: int, most: int) -> Index:
    """Indices to show of ``count`` if at most ``most`` (two or more; 0: all) are allowed, with first and last.

    It takes every second, every fourth, and so on. While the count grows the choice stays the same until it is too
    large; then it is halved.
    """
    stride = 1
    while most and -(-(count - 1) // stride) + 1 > max(most, 2):
        stride *= 2
    kept = np.arange(0, count, stride)
    return kept if count == 0 or kept[-1] == count - 1 else np.append(kept, count - 1)


def worst_and_some(ids: Index, misfit: Array, most: int) -> Index:
    """Select ids of edges with a misfit (n,), no more than ``most``, in order of their ids (n,).

    Half of them are the worst edges. The others are all edges whose id is divisible by a power of two.
    """
    if len(ids) <= most:
        return ids
    half = most // 2
    order = np.argpartition(-misfit, half)
    worst, others = ids[order[:half]], ids[order[half:]]
    stride = 1
    while len(others) > most - half:
        stride *= 2
        others = others[others % stride == 0]
    return np.sort(np.concatenate((worst, others)))

"""Compile every kernel once, so that nothing is compiled while a robot drives, and load all of them in one order.

A run must repeat byte for byte, and last digits depend on what machine code a process has of a formula. So kernels are
compiled in processes of their own, for one that compiles a kernel may get other digits from it than those that load it.
And several kernels bring the code of a formula they share, each optimised in its own surroundings: whichever is loaded
first gives it to all.

Each process compiles one part of the kernels, the same on every machine, however many cores it has: no kernel belongs
to two parts. What the plane needs is loaded before what space needs in addition, so that a drive in the plane computes
the same whether or not kernels of space are there.
"""

import contextlib
import functools
import gc
import inspect
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numba import types

from graph_slam_ros import graph as graphs
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import SE2, SE3, EdgeType, Gaussian, Graph, Loss
from graph_slam_ros.graph.vertices import PLANAR, adjoints_of_inverses
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.lie.jit import ARCHIVES, CACHE_DIR
from graph_slam_ros.progress import report
from graph_slam_ros.solver import METHODS, Settings, Solver, covariance, linearization
from graph_slam_ros.solver import update as updates
from graph_slam_ros.solver.clique_tree import incremental, numeric, ordering, storage, substitution
from graph_slam_ros.typing import Index

_KERNELS = 179  # about so many there are; a test compares it with the cache
_SHARED = "shared"  # file that is there when the kernels that two parts call are in the cache


@dataclass(frozen=True, slots=True)
class Compiling:
    """The progress of the compiler: kernels in the cache, of about so many, after so long."""

    done: int
    elapsed_s: float
    began_with: int = 0

    def __str__(self) -> str:
        done = min(self.done, _KERNELS - 1)
        new = done - self.began_with
        left_s = self.elapsed_s * (_KERNELS - done) / new if new > 0 else 0.0
        left = f", about {10 * math.ceil(left_s / 10)} s more" if left_s else ""
        why = f" (the wheel's are not for Numba {numba.__version__} on this processor)" if ARCHIVES else ""
        return f"compiling kernels, once per installation{why}: {100 * done / _KERNELS:.0f} %{left}"


OnProgress = Callable[[Compiling], None]


def are_compiled(dimensions: int = 3) -> bool:
    """Return whether all kernels are in the cache that work in the plane (2), or also in space (3)."""
    return bool(numba.config.DISABLE_JIT) or not _missing(dimensions)  # type: ignore[attr-defined]


def warmup(
    is_stop_requested: Callable[[], bool] = lambda: False, on_progress: OnProgress = report, dimensions: int = 3
) -> float:
    """Compile what is not compiled yet, and load it, before anything is computed whose bytes repeat; returns seconds.

    ``is_stop_requested`` and ``on_progress`` are called while kernels are compiled, which may take minutes. The plane
    (2 ``dimensions``) needs fewer. Raises GraphSlamError: stopped on request; the next warm-up goes on from there.
    """
    start = time.perf_counter()
    compile_all(is_stop_requested, on_progress, dimensions)
    _load_plane()
    if dimensions == 3:
        _load_edges(in_space=True)
    return time.perf_counter() - start


def compile_all(
    is_stop_requested: Callable[[], bool] = lambda: False, on_progress: OnProgress = report, dimensions: int = 3
) -> None:
    """Compile what is not compiled yet, and load nothing; as ``warmup``."""
    if are_compiled(dimensions):
        return
    start, began_with = time.perf_counter(), _cached()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-m", __name__]
    running = [
        subprocess.Popen([*command, part], env=environment, start_new_session=True, stderr=subprocess.PIPE)
        for part in _missing(dimensions)
    ]
    try:
        while running:
            for process in running[:]:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    _, errors = process.communicate(timeout=0.1)
                    running.remove(process)
                    _refuse_failure(process.returncode, errors)
            on_progress(Compiling(_cached(), time.perf_counter() - start, began_with))
            if is_stop_requested():
                raise GraphSlamError("stopped before all kernels were compiled")
    finally:
        for process in running:  # also at Ctrl-C, which they do not get themselves
            process.kill()
            process.communicate()


def _missing(dimensions: int) -> list[str]:
    return [part for part in list(_PARTS)[:dimensions] if not (CACHE_DIR / f"complete-{part}").exists()]


def _refuse_failure(code: int, errors: bytes) -> None:
    if code:
        why = errors.decode(errors="replace").strip().splitlines()[-1:] or [f"exit code {code}"]
        remedy = "GRAPH_SLAM_CACHE names a folder with 100 MB of room"
        raise GraphSlamError(f"{CACHE_DIR}: kernels could not be compiled: {why[0]}; {remedy}")


def _cached() -> int:
    return len({kernel.name for kernel in CACHE_DIR.rglob("*.nbi")})


@functools.cache  # what is loaded stays
def _load_plane() -> None:
    """Linearise every edge type of the plane, and solve a graph."""
    _load_edges(in_space=False)
    _make(*_TWICE, *_STRUCTURE, *_NUMBERS)
    adjoints_of_inverses(PLANAR, np.zeros((1, 3)))
    linearization.loss_weights(0, 1.0, np.zeros(1))
    graph = Graph()
    poses = graph.add_vertices(SE2, np.zeros((2, 3)))
    point = graph.add_vertex(graphs.R2, np.zeros(2))
    planar, flat = (Gaussian.from_sigmas(*[1.0] * dof) for dof in (3, 2))
    graph.add_edge(graphs.POSE_PRIOR, [poses[0]], [0, 0, 0], planar, "anchor")
    graph.add_edge(graphs.RELATIVE_POSE, poses, [1, 0, 0.1], planar, "odometry")
    for _ in range(2):
        graph.add_edge(graphs.LANDMARK_POSITION, [poses[0], point], [1, 1], flat, "landmarks")
    settings = Settings(losses={"landmarks": [Loss(graphs.HUBER), Loss()]}, relinearize_above=0.0, relinearize_every=1)
    solver = Solver(graph, settings)
    edges = range(graph.edge_count - 1)
    solver.add(range(graph.vertex_count), edges)
    solver.update()
    graph.has_label(np.arange(graph.edge_count), ())
    solver.marginal([0])
    solver.joint_marginal([0, 1])
    for are_inside in (True, False):
        solver.edge_marginals(poses[None], are_inside=are_inside)
    solver.compact()
    solver.estimate([0])
    solver.add([], [edges.stop])
    solver.update()
    solver.set_weight(edges.stop, 0.0)
    solver.hold(0)
    solver.update()
    for method in METHODS:
        solver.start_at(graph.initial.values)
        solver.optimize(Settings(method))
    gc.freeze()  # what was loaded stays: no collection of garbage has to look at it again


@functools.cache
def _load_edges(*, in_space: bool) -> None:
    """Linearise an edge of each type with a pose in space, or of each other type, and propagate a covariance."""
    for value in vars(graphs).values():
        for edge in value.values() if isinstance(value, dict) else [value]:
            if not isinstance(edge, EdgeType) or in_space != any(SE3 in kinds for kinds in edge.accepts):
                continue
            sizes = [kinds[0].size for kinds in edge.accepts]
            edge.linearize(np.ones(sum(sizes)), np.cumsum([[0, *sizes[:-1]]], axis=1), np.ones((1, edge.measured_size)))
    group, step = (se3, se3.IDENTITY) if in_space else (se2, (1.0, 0.0, 0.1))
    unit = np.eye(6 if in_space else 3)
    group.propagate_during(unit, step, unit)
    group.propagate(unit, step, unit)
    group.compose_one(group.IDENTITY, group.between_one(group.IDENTITY, group.IDENTITY))
    if not in_space:
        SE2.retract(np.zeros((1, 3)), np.zeros((1, 3)))


# Two parts call the first. The others take most of the time, or are needed after a failure, perhaps without memory.
_TWICE = (
    *(storage.ascending, storage.chosen, storage.in_order, storage.joined, storage.lengthened),
    *(incremental.mark, numeric.accept_steps),
)
_STRUCTURE = (
    *(ordering.move_tail, ordering.dissect, incremental.regroup, incremental.reset),
    *(incremental.relinearize, incremental.reach_back, storage.compact),
)
_NUMBERS = (*(numeric.eliminate, substitution.substitute, incremental.solve, updates.update), covariance.joint)


def _compile_structure() -> None:
    """Compile kernels that two parts call, those of the structure, and, when the plane's are there, what is left."""
    _make(*_TWICE)
    (CACHE_DIR / _SHARED).touch()
    _make(*_STRUCTURE)
    adjoints_of_inverses(PLANAR, np.zeros((1, 3)))  # no other part has them
    _wait_for("complete-plane")
    _load_plane()


def _compile_plane() -> None:
    """Compile the edges of the plane, then elimination and covariances."""
    _load_edges(in_space=False)
    _wait_for(_SHARED)
    _make(*_NUMBERS)


def _make(*kernels: Any) -> None:
    """Compile kernels, or load them, for arguments as their annotations say."""
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        return
    limits = types.UniTuple(types.float64, 3)  # type: ignore[no-untyped-call]
    tree = numba.typeof(storage.empty_tree())  # type: ignore[no-untyped-call]
    of = {storage.Tree: tree, Index: types.int64[::1], int: types.int64, float: types.float64, storage.Limits: limits}
    for kernel in kernels:
        kernel.compile(tuple(of[one.annotation] for one in inspect.signature(kernel.py_func).parameters.values()))


def _wait_for(name: str) -> None:
    """Let another part come first; where nobody waits for this one any more, stop."""
    parent = os.getppid()
    while not (CACHE_DIR / name).exists():
        if os.getppid() != parent:
            sys.exit(1)
        time.sleep(0.05)


_PARTS: dict[str, Callable[[], None]] = {"structure": _compile_structure, "plane": _compile_plane}
_PARTS["space"] = functools.partial(_load_edges, in_space=True)
"""The plane needs the first two. They run at the same time, for each waits for kernels of the other."""


if __name__ == "__main__":
    gc.disable()  # an eighth of the time; all goes at the end of the process
    _PARTS[sys.argv[1]]()
    (CACHE_DIR / f"complete-{sys.argv[1]}").touch()

"""Compile every kernel once, so that nothing is compiled while a robot drives, and load all of them in one order.

A run must repeat byte for byte, and last digits depend on what machine code a process has of a formula. So kernels are
compiled in a process of their own, for one that compiles a kernel may get other digits from it than those that load it.
And several kernels bring the code of a formula they share, each optimised in its own surroundings: whichever is loaded
first gives it to all.
"""

import contextlib
import functools
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numba
import numpy as np

from graph_slam_ros import graph as graphs
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import (
    HUBER,
    LANDMARK_POSITION,
    POSE_PRIOR,
    POSE_PRIOR_3D,
    R2,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    EdgeType,
    Gaussian,
    Graph,
    Loss,
)
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.lie.jit import CACHE_DIR, COMPILED
from graph_slam_ros.progress import report
from graph_slam_ros.solver import METHODS, Settings, Solver

_KERNELS = 115  # about so many there are; a test compares it with the cache


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
        left = "" if not left_s else f", about {10 * math.ceil(left_s / 10)} s more"
        return f"compiling kernels, once per installation: {100 * done / _KERNELS:.0f} %{left}"


def are_compiled() -> bool:
    """Return whether all kernels are in the cache."""
    return COMPILED.exists() or bool(numba.config.DISABLE_JIT)  # type: ignore[attr-defined]


Tell = Callable[[Compiling], None]


def warmup(is_told_to_stop: Callable[[], bool] = lambda: False, tell: Tell = lambda now: report(str(now))) -> float:
    """Compile what is not compiled yet, and load all; returns the seconds it took.

    Before anything is computed whose bytes are to be repeated.

    Parameters
    ----------
    is_told_to_stop : asked while kernels are compiled, which may take minutes
    tell : called meanwhile, several times a second

    Raises
    ------
    GraphSlamError
        Told to stop; the next warm-up goes on from there.
    """
    start = time.perf_counter()
    compile_all(is_told_to_stop, tell)
    _use_all()
    return time.perf_counter() - start


def compile_all(is_told_to_stop: Callable[[], bool] = lambda: False, tell: Tell = lambda now: report(str(now))) -> None:
    """Compile what is not compiled yet, and load nothing; as ``warmup``."""
    if not are_compiled():
        _compile(is_told_to_stop, tell)


def _compile(is_told_to_stop: Callable[[], bool], tell: Tell) -> None:
    """Once per installation, into the cache on disk."""
    start, began_with = time.perf_counter(), _cached()
    command, path = [sys.executable, "-m", __name__], os.pathsep.join(filter(None, sys.path))
    environment = os.environ | {"PYTHONPATH": path}
    with subprocess.Popen(command, env=environment, start_new_session=True, stderr=subprocess.PIPE) as compiler:
        try:
            while (said := _ended(compiler)) is None:
                tell(Compiling(_cached(), time.perf_counter() - start, began_with))
                if is_told_to_stop():
                    raise GraphSlamError("told to stop before all kernels were compiled")
        finally:
            compiler.kill()  # Ctrl-C, which it does not hear itself
    if compiler.returncode:
        why = said.decode(errors="replace").strip().splitlines()[-1:] or [f"exit code {compiler.returncode}"]
        remedy = "GRAPH_SLAM_CACHE names a folder with 100 MB of room"
        raise GraphSlamError(f"{CACHE_DIR}: kernels could not be compiled: {why[0]}; {remedy}")


def _cached() -> int:
    """Kernels in the cache, each in a file of its own."""
    return len({file.name for file in CACHE_DIR.rglob("*.nbi")})


def _ended(process: "subprocess.Popen[bytes]") -> bytes | None:
    """The compiler's standard error, if it ends soon."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        return process.communicate(timeout=0.1)[1]
    return None


@functools.cache  # what is loaded stays
def _use_all() -> None:
    """Linearise every edge type and solve a graph."""
    for edge in _edge_types():
        sizes = [kinds[0].size for kinds in edge.accepts]
        edge.linearize(np.ones(sum(sizes)), np.cumsum([[0, *sizes[:-1]]], axis=1), np.ones((1, edge.measured_size)))
    graph = Graph()
    poses = graph.add_vertices(SE2, np.zeros((2, 3)))
    point = graph.add_vertex(R2, np.zeros(2))
    space = graph.add_vertices(SE3, [[0, 0, 0, 0, 0, 0, 1.0]] * 2)
    planar, flat, six = (Gaussian.from_sigmas(*[1.0] * dof) for dof in (3, 2, 6))
    graph.add_edge(POSE_PRIOR, [poses[0]], [0, 0, 0], planar, "anchor")
    graph.add_edge(RELATIVE_POSE, poses, [1, 0, 0.1], planar, "odometry")
    graph.add_edge(POSE_PRIOR_3D, [space[0]], [0, 0, 0, 0, 0, 0, 1], six, "anchor")
    graph.add_edge(RELATIVE_POSE_3D, space, [1, 0, 0, 0, 0, 0, 1], six, "odometry")
    for _ in range(2):
        graph.add_edge(LANDMARK_POSITION, [poses[0], point], [1, 1], flat, "landmarks")
    solver = Solver(
        graph, Settings(losses={"landmarks": [Loss(HUBER), Loss()]}, relinearize_above=0.0, relinearize_every=1)
    )
    edges = range(graph.edge_count - 1)
    solver.add(range(graph.vertex_count), edges)
    solver.update()
    solver.marginal([0])
    solver.joint_marginal([0, 1])
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
    SE2.retract(np.zeros((1, 3)), np.zeros((1, 3)))
    se2.noise_during((1.0, 0.0, 0.1), np.eye(3))
    se2.propagate_during(np.eye(3), (1.0, 0.0, 0.1), np.eye(3))
    se2.propagate(np.eye(3), (1.0, 0.0, 0.1), np.eye(3))
    se3.propagate_during(np.eye(6), se3.IDENTITY, np.eye(6))
    se3.noise_during(se3.IDENTITY, np.eye(6))
    se3.propagate(np.eye(6), se3.IDENTITY, np.eye(6))


def _edge_types() -> Iterator[EdgeType]:
    for value in vars(graphs).values():
        if isinstance(value, dict):
            yield from (edge for edge in value.values() if isinstance(edge, EdgeType))
        elif isinstance(value, EdgeType):
            yield value


if __name__ == "__main__":
    _use_all()
    COMPILED.touch()

"""Compiled loops: with bounds checked, without compilation, and all compiled by the warm-up."""

import os
import shutil
import subprocess
import sys

import pytest
from places import ROOT, test_path
from reliability import times

from graph_slam_ros import warmup

TEST = ROOT / "test"
# Small, and between them they call every kernel.
SMALL = [
    "test_lie.py",
    "test_graph.py",
    "test_solver.py::test_a_report_adds_up",
    "test_solver.py::test_a_held_vertex_stays_and_is_certain",
    "test_solver.py::test_where_all_is_held_nothing_is_to_do",
    "test_solver.py::test_marginals_are_the_blocks_of_the_dense_inverse",
    "test_solver.py::test_a_joint_marginal_is_the_block_of_the_dense_inverse_in_the_order_asked_for",
    "test_edges.py",
    "test_solver.py::test_vectors_are_solved_in_one_step_to_the_weighted_mean",
    "test_solver.py::test_G1_parts_without_a_link_are_solved_as_if_alone",
    "test_online.py::test_updates_that_fail_many_times_write_nothing_beyond_the_arrays",
    "test_online.py::test_a_vertex_is_held_at_its_estimate_and_not_where_it_was_linearised",
    "test_online.py::test_a_removed_vertex_may_be_added_again_and_is_there_once[60-40]",
    "test_ordering.py::test_the_tree_holds_after_edges_between_old_vertices_and_without_some[0]",
    "test_ordering.py::test_what_a_separator_separates_is_never_adjacent[drive-200]",
    "test_dense.py::test_elimination_leaves_the_factor_and_the_schur_complement[37-15-1]",
]


def python(*words, **environment):
    inherited = {name: value for name, value in os.environ.items() if name != "PYTEST_ADDOPTS"}  # colcon's own
    return subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, cwd=ROOT, env=inherited | environment, timeout=900
    )


@pytest.mark.parametrize("setting", ["NUMBA_DISABLE_JIT", *times([], ["NUMBA_BOUNDSCHECK"])])  # compiles for minutes
def test_the_small_tests_pass_with(setting):
    done = python("-m", "pytest", "-q", *map(test_path, SMALL), **{setting: "1"})
    assert done.returncode == 0, done.stdout[-3000:]
    assert " passed" in done.stdout


BEYOND = """
import numpy as np
from graph_slam_ros.graph.edges import _pose_prior
from graph_slam_ros.lie.jit import CACHE_DIR
print(CACHE_DIR)
_pose_prior(np.zeros(3), np.array([[{at}]]), np.zeros((1, 3)))
"""


def test_code_compiled_without_bounds_checks_is_not_served_where_they_are_asked_for(tmp_path):
    cache = {"GRAPH_SLAM_CACHE": str(tmp_path)}
    plain = python("-c", BEYOND.format(at=0), NUMBA_BOUNDSCHECK="0", **cache)
    assert plain.returncode == 0, plain.stderr
    checked = python("-c", BEYOND.format(at=1), NUMBA_BOUNDSCHECK="1", **cache)
    assert "IndexError" in checked.stderr
    assert checked.stdout != plain.stdout


MARK = "from graph_slam_ros.lie.jit import CACHE_DIR, COMPILED; print(CACHE_DIR, COMPILED.name)"


def test_what_was_compiled_of_another_copy_of_the_sources_is_compiled_anew_for_this_one(tmp_path):
    marks = []
    for place in ("one", "other"):
        package = tmp_path / place / "graph_slam_ros"
        shutil.copytree(TEST.parent / "graph_slam_ros", package, ignore=shutil.ignore_patterns("__pycache__"))
        done = python("-c", MARK, PYTHONPATH=str(package.parent), GRAPH_SLAM_CACHE=str(tmp_path))
        marks.append(done.stdout.split())
    (one_cache, one), (other_cache, other) = marks
    assert one_cache == other_cache
    assert one != other


COMPILED_LATER = """
import sys
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.warmup import warmup

def signatures():
    modules = [m for name, m in list(sys.modules.items()) if name.startswith("graph_slam_ros")]
    kernels = {f"{f.__module__}.{f.__name__}": f for m in modules for f in vars(m).values() if hasattr(f, "signatures")}
    return {name: len(f.signatures) for name, f in kernels.items()}

warmup()
before = signatures()
for path in sys.argv[1:]:
    file = read_g2o(path)
    solver = Solver(file.graph)
    solver.add(range(file.graph.vertex_count), range(file.graph.edge_count))
    solver.hold(0)
    solver.update()
    for method in ("gn", "lm", "dogleg"):
        solver.optimize(Settings(method=method, max_iterations=2))
    solver.marginal([1])
    solver.joint_marginal([1, 2])
    solver.set_weight(file.graph.edge_count - 1, 0.0)
    solver.update()
print([name for name, count in signatures().items() if count != before.get(name, 0)])
"""


def test_the_progress_of_the_compiler_counts_to_about_as_many_kernels_as_there_are():
    warmup.warmup()
    assert warmup._cached() == pytest.approx(warmup._KERNELS, rel=0.1)
    assert str(warmup.Compiling(warmup._KERNELS // 2, 30.0)).endswith(": 50 %, about 40 s more")
    assert str(warmup.Compiling(2 * warmup._KERNELS, 30.0)).endswith(": 99 %, about 10 s more")


def test_the_warm_up_compiles_all_that_solving_a_graph_needs():
    graphs = [str(TEST.parent / "data" / name) for name in ("city.g2o", "landmarks.g2o")]
    done = python("-c", COMPILED_LATER, *graphs)
    assert done.stdout.splitlines() == ["[]"], done.stdout + done.stderr

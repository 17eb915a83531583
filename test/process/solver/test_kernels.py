"""Compiled loops: kept and found again, and all compiled by the warm-up."""

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from places import ROOT
from reliability import times

from graph_slam_ros import warmup
from graph_slam_ros.lie import jit

ONE_KERNEL = """
import numpy as np
from graph_slam_ros.graph.edges import _pose_prior
from graph_slam_ros.lie.jit import CACHE_DIR
result = _pose_prior(np.zeros(3), np.zeros((1, 1), int), np.array([[1.0, 2.0, 3.0]]))
stats = _pose_prior.stats
print(CACHE_DIR, sum(stats.cache_hits.values()), sum(stats.cache_misses.values()), *(a.tobytes().hex() for a in result))
"""


def copied(folder):
    package = folder / "graph_slam_ros"
    return shutil.copytree(ROOT / "graph_slam_ros", package, ignore=shutil.ignore_patterns("__pycache__"))


def one_kernel(place, cache, executable=sys.executable, **more):
    """Of a package copied there: where a kernel lies, loaded, compiled, and what it computes."""
    path = os.pathsep.join([str(place), *(path for path in sys.path if path.endswith("-packages"))])
    variables = {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", "GRAPH_SLAM_CACHE": str(cache)} | more
    command, variables = [str(executable), "-c", ONE_KERNEL], os.environ | variables
    done = subprocess.run(command, cwd=place, env=variables, capture_output=True, text=True, timeout=120)
    folder, hits, misses, *result = done.stdout.split()
    return folder, int(hits), int(misses), result


def test_a_moved_copy_and_a_second_environment_load_what_was_compiled(tmp_path):
    environment, cache = tmp_path / "environment", tmp_path / "cache"
    venv.create(environment, symlinks=True, with_pip=False)
    copied(tmp_path / "one")
    package = copied(tmp_path / "moved")
    folder, *counts, _ = one_kernel(tmp_path / "one", cache)
    assert counts == [0, 1]
    for file in package.rglob("*.py"):
        os.utime(file, (1e9, 1e9))
    assert one_kernel(package.parent, cache, environment / "bin" / "python")[:3] == (folder, 1, 0)
    other, *counts, _ = one_kernel(package.parent, cache, NUMBA_BOUNDSCHECK="1")
    assert (other != folder, counts) == (True, [0, 1]), "what is compiled without checks of bounds has none"
    edges, so3 = package / "graph" / "edges.py", package / "lie" / "so3.py"
    edges.write_text('"""Another docstring.\n"""\n# and a comment\n' + edges.read_text().split('"""', 2)[2])
    assert one_kernel(package.parent, cache)[:3] == (folder, 1, 0)
    so3.write_text(so3.read_text() + "_CHANGED = 1\n")
    other, *counts, _ = one_kernel(package.parent, cache)
    assert (other != folder, counts) == (True, [0, 1])


def test_kernels_of_a_wheel_are_loaded_and_two_processors_linearise_to_the_same_bytes(tmp_path):
    package = copied(tmp_path / "wheel")
    portable = {"NUMBA_CPU_NAME": jit.PROCESSOR, "NUMBA_CPU_FEATURES": ""}
    made, *compiled = one_kernel(package.parent, tmp_path / "built", **portable)
    assert compiled[:2] == [0, 1]
    native, *counts, result = one_kernel(package.parent, tmp_path / "native")
    assert (Path(native).name != Path(made).name, counts, result) == (True, [0, 1], compiled[2])
    shutil.make_archive(package / Path(made).name, "zip", made)
    files = sorted(package.rglob("*"))
    assert one_kernel(package.parent, tmp_path / "user")[1:] == (1, 0, result)
    assert one_kernel(package.parent, "/dev/null", TMPDIR=str(tmp_path))[1:] == (1, 0, result), "without a home"
    assert one_kernel(package.parent, tmp_path / "user", NUMBA_OPT="2")[1:3] == (0, 1), "another compiler"
    assert sorted(package.rglob("*")) == files


@pytest.mark.skipif(not times(0, 1), reason="only in make soak")  # compiles for minutes
@pytest.mark.parametrize("how", ["one core", "two cores", "wheel"])
def test_one_core_and_two_compute_the_same_bytes_and_a_wheel_the_same_path(tmp_path, how):
    """Against the kernels that all tests use; those of a wheel add up a front in another order, and all are there."""
    command = [sys.executable, "-m", "graph_slam_ros.cli", "replay", str(ROOT / "data" / "demo.mcap"), "--out"]
    new = os.environ | {"GRAPH_SLAM_CACHE": str(tmp_path / "cache")}
    if how == "wheel":
        as_it_is = [f"VENV={sys.prefix}", "-o", f"{sys.prefix}/package.stamp"]
        subprocess.run(["make", "wheel", f"DIST={tmp_path}", *as_it_is], cwd=ROOT, check=True, capture_output=True)
        pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--target", str(tmp_path / "site")]
        subprocess.run([*pip, *map(str, tmp_path.glob("*.whl"))], check=True, capture_output=True)
        new["PYTHONPATH"] = str(tmp_path / "site")
    subprocess.run([*command, str(tmp_path / "old")], check=True, capture_output=True)
    pinned = {"preexec_fn": lambda: os.sched_setaffinity(0, [0])} if how == "one core" else {}
    command += [str(tmp_path / "new")]
    subprocess.run(command, cwd=tmp_path, env=new, check=True, capture_output=True, **pinned)
    for archive in (tmp_path / "site").glob("*/kernels-*.zip"):
        brought = {Path(name).name for name in ZipFile(archive).namelist() if ".nb" in name}
        assert {file.name for file in (tmp_path / "cache").rglob("*.nb?")} == brought
    names = {file.name for file in (tmp_path / "old").iterdir()} - {"run.json"}
    assert len(names) > 10
    paths = [np.loadtxt(tmp_path / run / "path.tum") for run in ("old", "new")]
    assert paths[0] == pytest.approx(paths[1], rel=0.0, abs=1e-9)
    for name in names if how != "wheel" else ():
        assert (tmp_path / "new" / name).read_bytes() == (tmp_path / "old" / name).read_bytes(), name


COMPILED_LATER = """
import sys
import numpy as np
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph import BEARING, LANDMARK_POSITION, R2, RELATIVE_POSE, SE2, Gaussian
from graph_slam_ros.slam.robust.innovation import innovations
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
    if file.graph.kinds[0] is not SE2:
        continue
    # arrays of any layout; then the search for the least cost of a bearing to a landmark that may lie anywhere
    far = file.graph.add_vertices(R2, np.array([[3.0, 4.0]]))
    ends, noise = np.asfortranarray([[0, 1], [1, 2]]), Gaussian.from_sigmas(1.0, 1.0, 1.0)
    ends.flags.writeable = False
    file.graph.add_edges(RELATIVE_POSE, ends, np.zeros((3, 2)).T, noise, "other")
    vague, sharp = Gaussian.from_sigmas(30.0, 30.0), Gaussian.from_sigmas(0.1)
    seen = file.graph.add_edge(LANDMARK_POSITION, [0, far[0]], [3.0, 4.0], vague, "seen")
    solver.add(far, [seen])
    seen = file.graph.add_edge(BEARING, [1, far[0]], [0.5], sharp, "seen")
    assert 0.0 <= innovations(file.graph, solver, [seen])[0]
print([name for name, count in signatures().items() if count != before.get(name, 0)])
"""


def test_the_progress_of_the_compiler_counts_to_about_as_many_kernels_as_there_are(monkeypatch):
    warmup.warmup()
    assert warmup._cached() == pytest.approx(warmup._KERNELS, rel=0.1)
    assert str(warmup.Compiling(warmup._KERNELS // 2, 30.0)).endswith(": 50 %, about 40 s more")
    assert str(warmup.Compiling(2 * warmup._KERNELS, 30.0)).endswith(": 99 %, about 10 s more")
    monkeypatch.setattr(warmup, "ARCHIVES", ["kernels-of-another-numba.zip"])
    assert "(the wheel's are not for Numba " in str(warmup.Compiling(1, 0.0))


def test_the_warm_up_compiles_all_that_solving_a_graph_needs():
    graphs = [str(ROOT / "data" / name) for name in ("city.g2o", "landmarks.g2o")]
    command = [sys.executable, "-c", COMPILED_LATER, *graphs]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=900)
    assert done.stdout.splitlines() == ["[]"], done.stdout + done.stderr

"""A disk that is full, folders that are not there and odd variables: one line, its exit code, nothing half-written."""

import ctypes
import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest
import reliability
from plain_rights import answer, plain_rights

from graph_slam_ros import cli, warmup
from graph_slam_ros.lie import jit
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.tools.simulation import simulate, write_bag

MOST = 200
_NEW_MOUNTS, _PRIVATE = 0x20000, 1 << 18 | 1 << 14


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    write_bag(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=4.0), folder / "drive.mcap")
    replay(folder / "drive.mcap", folder / "run")
    assert cli.main(["map", "export", str(folder / "run"), "--out", str(folder / "graph.g2o")]) == 0
    return folder


def in_a_child(function, *arguments):
    """What a function returns in a process of its own, which is a copy of this one."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
        return pool.submit(function, *arguments).result(120)


def small(folder, kilobytes):
    """A disk of so many kilobytes for this process alone; False where it may not have one."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_NEW_MOUNTS) or libc.mount(b"none", b"/", None, _PRIVATE, None):
        return False
    return not libc.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", 0, f"size={kilobytes}k".encode())


FULL = {  # what is written, and how it is called
    "simulate": "simulate warehouse --set aisles=2 --set laps=1 --out DISK/a.mcap",
    "a graph": "simulate city --poses 300 --out DISK/a.g2o",
    "replay": "replay BAG --out DISK/out",
    "recover": "recover RUN --out DISK/out",
    "freeze": "map freeze RUN --out DISK/out",
    **{name: f"map export RUN --out DISK/a.{name}" for name in ("tum", "g2o", "mcap", "png")},
    "optimize": "optimize GRAPH --out DISK/a.g2o",
    "poses": "optimize GRAPH --out DISK/a.tum",
}


def on_a_full_disk(made, disk):
    """Of each command: exit code, lines on standard error, what is left there; last of one that compiles."""
    if not small(disk, 64):
        return None
    out, names = {}, {"BAG": made / "drive.mcap", "RUN": made / "run", "GRAPH": made / "graph.g2o"}
    (disk / "mine").write_bytes(bytes(60 * 1024))
    for name, words in [*FULL.items(), ("kernels", "optimize GRAPH")]:
        if name == "kernels":
            os.environ["GRAPH_SLAM_CACHE"] = str(disk)
            jit.CACHE_DIR = warmup.CACHE_DIR = jit._cache_dir()
        code, err = answer(*(names.get(word, word.replace("DISK", str(disk))) for word in words.split()))
        left = sorted(str(path.relative_to(disk)) for path in disk.rglob("*") if path.name != "mine")
        out[name] = (code, err, left)
        for path in sorted(disk.rglob("*"), reverse=True):
            if path.name != "mine":
                path.rmdir() if path.is_dir() else path.unlink()
    out["mine"] = (disk / "mine").read_bytes() == bytes(60 * 1024)
    return out


def test_on_a_full_disk_each_command_says_so_and_leaves_nothing_half_written(made, tmp_path):
    (tmp_path / "disk").mkdir()
    found = in_a_child(on_a_full_disk, made, tmp_path / "disk")
    if found is None:
        pytest.skip("no file system may be mounted here")
    assert found.pop("mine")
    code, err, _ = found.pop("kernels")
    assert (code, err[:-1]) == (2, [line for line in err[:-1] if "compiling kernels" in line])
    assert "No space left on device" in err[-1] and "GRAPH_SLAM_CACHE" in err[-1]
    for name, (code, err, left) in found.items():
        assert (code, len(err)) == (2, 1), (name, code, err)
        assert "No space left on device" in err[0] and str(tmp_path) in err[0], (name, err)
        assert len(err[0]) <= MOST, name
        assert not left or name in ("replay", "recover", "freeze"), (name, left)  # those journal what they accept
        assert not [file for file in left if file.endswith((".new", ".csv", ".tum", ".g2o"))], (name, left)
        reliability.tell("full_disk", tried=1, failed=0)


HOMES = {  # variables, and in which folder kernels are kept then
    "no home": ({"HOME": None}, ""),
    "a home that is write-protected": ({"HOME": "LOCKED"}, "TMP"),
    "a home that is a file": ({"HOME": "FILE"}, "TMP"),
    "a cache that is a device": ({"GRAPH_SLAM_CACHE": "/dev/null"}, "TMP"),
    "a cache of too long a name": ({"GRAPH_SLAM_CACHE": "/" + "a" * 9999}, "TMP"),
    "a cache that is write-protected": ({"GRAPH_SLAM_CACHE": "LOCKED"}, "TMP"),
    "a cache of nothing": ({"GRAPH_SLAM_CACHE": "", "XDG_CACHE_HOME": "OWN"}, "OWN"),
    "no folder for temporary files": ({"GRAPH_SLAM_CACHE": "OWN", "TMPDIR": "/nowhere"}, "OWN"),
}


def test_without_a_home_a_cache_or_tmp_kernels_are_kept_elsewhere(tmp_path, monkeypatch):
    for k, (name, (variables, where)) in enumerate(HOMES.items()):
        places = {key: tmp_path / str(k) / key.lower() for key in ("LOCKED", "TMP", "OWN", "FILE")}
        for key in ("LOCKED", "TMP", "OWN"):
            places[key].mkdir(parents=True)
        places["FILE"].write_text("mine")
        places["LOCKED"].chmod(0o500)
        with monkeypatch.context() as patched:
            for key in ("HOME", "GRAPH_SLAM_CACHE", "XDG_CACHE_HOME"):
                patched.delenv(key, raising=False)
            patched.setenv("TMPDIR", str(places["TMP"]))
            patched.setattr("tempfile.tempdir", None)
            for key, value in variables.items():
                for place, path in places.items():
                    value = value and value.replace(place, str(path))
                patched.setenv(key, value) if value is not None else patched.delenv(key, raising=False)
            patched.chdir(tmp_path)
            with plain_rights():
                folder = jit._cache_dir()
        assert not where or folder.is_relative_to(places[where]), (name, folder)
        assert folder.stat().st_mode & 0o077 == 0, name
        assert places["FILE"].read_text() == "mine", name
        reliability.tell("environment", tried=1, failed=0)


ODD = {"LANG": "C", "LC_ALL": "nonsense", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii", "PYTHONHASHSEED": "0"}
ODD |= {"COLUMNS": "0", "LINES": "-1", "NO_COLOR": "", "TERM": "", "ROS_DOMAIN_ID": "abc", "MPLBACKEND": "nonsense"}
ODD |= {"RMW_IMPLEMENTATION": "nonsense", "GRAPH_SLAM_PROGRESS": "x", "OPENBLAS_NUM_THREADS": "x"}
TOLD = """
import sys
from graph_slam_ros import cli
run, out = sys.argv[1:]
for words in (["map", "export", run, "--out", out], ["explain", run, "\\u00e4\\u202e"], ["params", "min_distance"]):
    print("code", cli.main(words), file=sys.stderr)
"""


def test_odd_variables_change_nothing_of_what_is_answered(made, tmp_path):
    """All at once: what fails, fails by one of them."""
    words = [sys.executable, "-c", TOLD, made / "run", tmp_path / "a.png"]
    done = subprocess.run(words, env=os.environ | ODD, capture_output=True, timeout=300)
    err = done.stderr.decode().splitlines()
    assert done.returncode == 0, err
    assert [line for line in err if line.startswith("code")] == ["code 0", "code 2", "code 0"], err
    assert [line for line in err if "graph_slam: " in line] == [line for line in err if "\\xe4\\u202e" in line], err
    assert not any("Traceback" in line for line in err), err
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    reliability.tell("environment", tried=len(ODD), failed=0)

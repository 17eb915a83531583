"""What takes too long for every test run: ``make soak``, two programmes at a time, each with its output in soak/."""

import argparse
import hashlib
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

from places import ROOT, test_path

HERE = ROOT / "test"
OUT = ROOT / "soak"
PASSED = "soak: passed"


def tests(*words):
    files = [test_path(word) if word.startswith("test_") else word for word in words]
    return [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]


DRIVES = (
    *("advise", *(f"calibration_{name}" for name in ("consistency", "doubt", "space"))),
    *("calibrate", "certificate", "condense", "condensed_maps", "consistency"),
    *("displacement", "extreme_fixes", "gyro_drives", "gyro_findings"),
    *("determination", "initialization", "maps", "online_graphs", "planted", "rates", "repair"),
    *("simulation", "recordings", "uncorrected", "unnamed"),
)
PROGRAMMES = {
    "lifelong": [
        *(sys.executable, "-m", "benchmarks.lifelong", "--keyframes", "1000000", "--seeds", "1"),
        *("--windows", "60", "--flat"),
    ],
    "lives": tests("test_life.py"),
    "mutated_bags": tests("test_mutated_recordings.py"),
    "soak": tests("test_soak.py"),
    "large": tests("test_large.py"),
    "bursts": tests("test_extreme_fixes.py"),
    "journal": tests("test_journal.py"),
    "messages": tests("test_any_message.py", "test_any_measurement.py", "test_any_columns.py"),
    "permutations": tests("test_timing_cases.py", "-k", "B1"),
    "solver_faults": tests("test_solver_faults.py", "test_graph_cases.py", "test_revisions.py"),
    "recorded": tests("test_recorded.py"),
    "fuzzing": tests("test_fuzzing.py"),
    "kernels": tests("test_kernels.py"),
    "bounds": ["env", "NUMBA_BOUNDSCHECK=1", *tests("test_lie.py", "test_graph.py", "test_edges.py", "test_online.py")],
    "drives": tests(*(f"test_{name}.py" for name in DRIVES)),
    "fleet": tests("test_fleet.py"),
    "odd_files": tests("test_odd_files.py"),
    "planted_faults": [sys.executable, "test/planted_faults.py"],
    "clean_recordings": [sys.executable, "test/clean_recordings.py", "--seeds", "7", "--public"],
    "planted_bugs": [sys.executable, "test/planted_bugs.py"],
    "recovery": [sys.executable, "-m", "benchmarks.recovery"],
    "stack": tests(*sorted(file.name for file in HERE.rglob("test_stack*.py"))),
}
"""The longest first."""


def code():
    """What a programme that is through was through with."""
    files = sorted(file for folder in ("graph_slam_ros", "test") for file in (ROOT / folder).rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def run(name, version):
    """Whether a programme passes."""
    told = OUT / f"{name}.txt"
    if told.is_file() and told.read_text().endswith(f"{PASSED} {version}\n"):
        say(name, told, "passed before")
        return True
    with told.open("w") as out:
        environment = os.environ | {"GRAPH_SLAM_SOAK": "10"}
        done = subprocess.run(PROGRAMMES[name], cwd=ROOT, env=environment, stdout=out, stderr=subprocess.STDOUT)
        print("soak: failed" if done.returncode else PASSED, version, file=out)
    say(name, told, f"failed: {told}" if done.returncode else "passed")
    return not done.returncode


def say(name, told, how):
    print(f"soak: {name} {how}", flush=True)
    for line in told.read_text().splitlines():
        if line.startswith("RELIABILITY"):
            print(line, flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PROGRAMMES)}")
    names = parser.parse_args().names or list(PROGRAMMES)
    strange = [name for name in names if name not in PROGRAMMES]
    if strange:
        parser.error(f"{strange[0]} is none of {', '.join(PROGRAMMES)}")
    OUT.mkdir(exist_ok=True)
    version = code()
    with ThreadPoolExecutor(2) as pool:
        return 0 if all(list(pool.map(lambda name: run(name, version), names))) else 1


if __name__ == "__main__":
    sys.exit(main())

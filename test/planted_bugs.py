"""Ten ways in which such systems are known to fail, put into a copy of this one, one at a time: tests must see each.

``python test/planted_bugs.py [NAME ...]`` copies the sources to a temporary folder, where the tests must pass as they
are and fail with each bug. Its exit code is 0 where all were caught.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NOT_COPIED = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info")
NOT_COPIED_OF_ROOT = {"benchmarks", "build", "install", "log", "runs", "soak"}
LIMIT_S, FIRST_LIMIT_S = 300, 1200  # the first compiles the kernels of the copy
BROKEN = ("ImportError", "ModuleNotFoundError", "NameError", "SyntaxError")  # of a bug that was badly planted
PASSED, FAILED = 0, 1  # exit codes of pytest


@dataclass(frozen=True)
class Bug:
    """A fault, and what must see it.

    Attributes
    ----------
    finding : what happens elsewhere
    changes : files of the package, what is there exactly once, and what is put there instead
    tests : each of which must fail
    """

    name: str
    finding: str
    changes: tuple[tuple[str, str, str], ...]
    tests: tuple[str, ...]

    def planted(self, root):
        """The files that change, by what is in them, and what is to be."""
        before, after = {}, {}
        for name, there, instead in self.changes:
            file = root / "graph_slam_ros" / name
            before.setdefault(file, file.read_text(encoding="utf-8"))
            text = after.get(file, before[file])
            assert text.count(there) == 1, f"{self.name}: {name} has {text.count(there)} times, not once:\n{there}"
            after[file] = text.replace(there, instead)
        return before, after


BUGS = (
    Bug(
        "undetermined_landmark",
        "one landmark by bearing alone makes the whole problem singular",
        (("slam/landmarks/landmark_map.py", "        if not candidate.reason:\n", "        if candidate.places:\n"),),
        ("test_pipeline_kinds.py::test_G3_a_landmark_seen_by_bearing_from_one_place_waits_and_says_why",),
    ),
    Bug(  # all of the check: a cost that is not finite fails its second half, too
        "unchecked_solution",
        "a solve that returns what is not finite counts as done",
        (
            (
                "slam/failure_guard.py",
                "        values, before = self._solver.values, self._last_good()\n",
                "        return\n",
            ),
        ),
        (
            "test_solver_faults.py::"
            "test_T14_whatever_fails_at_any_solve_the_last_good_estimate_stays_and_soon_one_succeeds[6]",
        ),
    ),
    Bug(  # in two layers: the first takes what is all zero for unknown, the second would refuse it
        "any_covariance",
        "a covariance that is zero or not positive definite is taken as it is",
        (
            (
                "messages/inputs/source.py",
                "        if lengths and not block[:lengths, :lengths].any():\n",
                "        if False:\n",
            ),
            ("messages/inputs/checks.py", "    repairs = []\n", "    return block, []\n"),
            ("messages/inputs/checks.py", "    if not block.any():\n", "    if False:\n"),
        ),
        (
            "test_message_cases.py::test_A7_zero_covariance_means_unknown",
            "test_message_cases.py::test_A9_a_covariance_that_is_not_positive_definite",
        ),
    ),
    Bug(  # of two: what is singular in the eyes of the graph is mended after this
        "no_condition_limit",
        "odometry that is too sure of itself breaks the factorisation",
        (("measurements/edge_noise.py", "    least = covariance + ", "    least = covariance + 0.0 * "),),
        (
            "test_graph_cases.py::"
            "test_A12_however_certain_odometry_says_it_is_its_edges_are_not_and_what_they_are_part_of_is_solved",
        ),
    ),
    Bug(  # below the node, whose worker would count and go on without a solution
        "fatal_solve",
        "a solve that raises ends the node",
        (("slam/failure_guard.py", "            self._fail(error)\n", "            raise error\n"),),
        (
            "test_graph_cases.py::"
            "test_G7_where_nothing_that_has_come_is_to_blame_the_last_good_estimate_is_held_until_it_heals",
        ),
    ),
    Bug(  # below the node, where clock and stamps both tell of a jump
        "ignored_time_jump",
        "after time has jumped back all that comes is refused as late",
        (("slam/graph_slam.py", "                self._forget_time()\n", "                pass\n"),),
        ("test_timing_cases.py::test_B7_after_a_jump_of_time_what_is_older_than_the_map_is_used_and_begins_a_segment",),
    ),
    Bug(
        "written_over",
        "results are written straight over those of before",
        (
            (
                "runs/recorder.py",
                "    write_whole(folder / name, data)\n",
                "    (folder / name).write_bytes(data)\n",
            ),
        ),
        ("test_journal.py::test_T11_a_crash_at_any_call_that_reaches_the_disk_loses_nothing_that_was_told",),
    ),
    Bug(
        "journal_at_the_end",
        "what was told is not on the disk when the node is killed",
        (
            (
                "runs/recorder.py",
                "            self._fill()\n            self._journal.flush()\n",
                "            return\n",
            ),
        ),
        ("test_journal.py::test_T11_a_crash_at_any_call_that_reaches_the_disk_loses_nothing_that_was_told",),
    ),
    Bug(
        "unchecked_chunks",
        "a damaged recording reads well, with other messages",
        (
            (
                "recordings/mcap_records.py",
                "    if chunk.uncompressed_crc not in (0, zlib.crc32(plain)):\n",
                "    if False:\n",
            ),
        ),
        (
            "test_file_cases.py::test_F3_a_flipped_bit_in_a_chunk_costs_that_chunk_alone_and_is_told",
            "test_journal.py::test_T9_F3_a_flipped_bit_gives_no_record_that_was_not_written_and_none_after_a_gap",
        ),
    ),
    Bug(  # both: what decides protects without a loss, and a loss without decisions
        "every_closure_believed",
        "false closures destroy the map",
        (
            ("config/robust.py", "    decide: bool = setting(True, ", "    decide: bool = setting(False, "),
            (
                "config/robust.py",
                '        "dcs", "of closures and fixes; ',
                '        "none", "of closures and fixes; ',
            ),
        ),
        ("test_decisions.py::test_G10_false_closures_pull_nothing_and_all_true_ones_stay",),
    ),
)


@dataclass(frozen=True)
class Ended:
    """How a session of pytest ended: its exit code, None where it took too long, and what was said of what failed."""

    code: int | None
    passed: int = 0
    errors: int = 0
    failures: tuple[str, ...] = ()

    @property
    def is_caught(self):
        """Whether every test ran, and failed by what it looks at."""
        is_broken = any(failure.startswith(BROKEN) for failure in self.failures)
        return self.code == FAILED and not (self.passed or self.errors or is_broken)

    def __str__(self):
        first = f", {self.failures[0]}" if self.failures else ""
        return f"exit code {self.code}, {self.passed} passed, {len(self.failures)} failed, {self.errors} errors{first}"


def _not_copied(folder, names):
    return NOT_COPIED(folder, names) | (NOT_COPIED_OF_ROOT & set(names) if Path(folder) == ROOT else set())


def ended(root, tests, limit_s):
    """Run tests of a copy in a process of its own."""
    report = root / "report.xml"
    report.unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junit-xml={report}"]
    environment = {name: value for name, value in os.environ.items() if name != "GRAPH_SLAM_SOAK"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
    environment |= {"PYTHONDONTWRITEBYTECODE": "1", "GRAPH_SLAM_CACHE": str(root / "cache")}
    with (
        (root / "output.txt").open("w") as output,
        subprocess.Popen(
            [*command, *(f"test/{test}" for test in tests)],
            cwd=root,
            env=environment,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        ) as child,
    ):
        try:
            code = child.wait(limit_s)
        except subprocess.TimeoutExpired:
            return Ended(None)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)  # with what it has begun
    if not report.exists():
        return Ended(code)
    (suite,) = ElementTree.parse(report).getroot()
    count, errors, skipped = (int(suite.get(key)) for key in ("tests", "errors", "skipped"))
    failures = tuple(one.get("message").partition("\n")[0] for one in suite.iter("failure"))
    return Ended(code, count - len(failures) - errors - skipped, errors, failures)


def caught(root, bug):
    """Whether a bug is seen."""
    start = time.monotonic()
    before, after = bug.planted(root)
    try:
        for file, text in after.items():
            file.write_text(text, encoding="utf-8")
        how = ended(root, bug.tests, LIMIT_S)
    finally:
        for file, text in before.items():
            file.write_text(text, encoding="utf-8")
    verdict = "caught" if how.is_caught else "NOT CAUGHT"
    print(f"{verdict} {bug.name} ({bug.finding}), {time.monotonic() - start:.0f} s: {how}", flush=True)
    if not how.is_caught:
        print((root / "output.txt").read_text())
    return how.is_caught


def main(*names):
    """Plant all bugs, or those of these names; returns the exit code."""
    if unknown := set(names) - {bug.name for bug in BUGS}:
        raise SystemExit(f"no bug is called {', '.join(sorted(unknown))}; there are {', '.join(b.name for b in BUGS)}")
    bugs = [bug for bug in BUGS if bug.name in (names or {bug.name for bug in BUGS})]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "copy"
        shutil.copytree(ROOT, root, ignore=_not_copied)
        tests = dict.fromkeys(test for bug in bugs for test in bug.tests)
        how = ended(root, tests, FIRST_LIMIT_S)
        print(f"without any bug: {how}", flush=True)
        if how.code != PASSED or how.passed < len(tests):
            print((root / "output.txt").read_text())
            return 1
        count = sum(caught(root, bug) for bug in bugs)
    print(f"RELIABILITY planted_bugs tried={len(bugs)} caught={count} failed={len(bugs) - count}")
    return int(count < len(bugs))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

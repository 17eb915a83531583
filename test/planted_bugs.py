"""Ten ways in which such systems are known to fail, put into a copy of this one, one at a time: tests must see each.

``python test/planted_bugs.py [NAME ...]`` copies the sources to a temporary folder, where the tests must pass as they
are and fail with each bug. Its exit code is 0 where all were caught. A bug is planted by a symbol's name, so that other
changes of the source leave it.
"""

import ast
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

from places import ROOT, test_path

NOT_COPIED = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info")
NOT_COPIED_OF_ROOT = {"benchmarks", "build", "install", "log", "runs", "soak"}
LIMIT_S, FIRST_LIMIT_S = 300, 1200  # the first compiles the kernels of the copy
BROKEN = ("ImportError", "ModuleNotFoundError", "NameError", "SyntaxError")  # of a bug that was badly planted
PASSED, FAILED = 0, 1  # exit codes of pytest


@dataclass(frozen=True)
class Change:
    """What one name of the package is instead.

    Attributes
    ----------
    file : of the package
    symbol : name in the module, or class and name: of a function or method, or of what a value is assigned to
    instead : body of the function, in which ``original`` is the function as it was; or the value
    """

    file: str
    symbol: str
    instead: str

    def made(self, text):
        """The source with the change. Raises LookupError where the symbol is not in it, once."""
        nodes = [ast.parse(text)]
        for name in self.symbol.split("."):
            nodes = [one for node in nodes for one in node.body if name in _names(one)]
        if len(nodes) != 1:
            raise LookupError(f"{self.file} has {self.symbol} {len(nodes)} times, not once: was it renamed or moved?")
        (node,) = nodes
        if isinstance(node, ast.Assign | ast.AnnAssign):
            lines = text.encode().splitlines(keepends=True)
            value, first, last = node.value, node.value.lineno - 1, node.value.end_lineno - 1
            start, end = lines[first][: value.col_offset], lines[last][value.end_col_offset :]
            lines[first : last + 1] = [start + self.instead.encode() + end]
            return b"".join(lines).decode()
        if node.decorator_list:
            raise LookupError(f"{self.file}: {self.symbol} has a decorator, which would be lost")
        for argument in ast.walk(node.args):
            if isinstance(argument, ast.arg):
                argument.annotation = None
        planted = f"def planted({ast.unparse(node.args)}):\n{textwrap.indent(self.instead, '    ')}\nreturn planted"
        return (
            f"{text}\n\ndef _plant(original):\n{textwrap.indent(planted, '    ')}\n\n\n"
            f"{self.symbol} = _plant({self.symbol})\n"
        )


def _names(node):
    """What a statement defines."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    if isinstance(node, ast.AnnAssign) and node.value is not None:
        return {ast.unparse(node.target)}
    return {ast.unparse(target).strip("()") for target in node.targets} if isinstance(node, ast.Assign) else set()


@dataclass(frozen=True)
class Bug:
    """A fault, and what must see it.

    Attributes
    ----------
    finding : what happens elsewhere
    tests : each of which must fail
    """

    name: str
    finding: str
    changes: tuple[Change, ...]
    tests: tuple[str, ...]

    def planted(self, root):
        """The files that change, by what is in them, and what is to be."""
        before, after = {}, {}
        for change in self.changes:
            file = root / "graph_slam_ros" / change.file
            if not file.is_file():
                raise LookupError(f"{self.name}: there is no {change.file}: was it renamed or moved?")
            before.setdefault(file, file.read_text(encoding="utf-8"))
            try:
                after[file] = change.made(after.get(file, before[file]))
            except LookupError as error:
                raise LookupError(f"{self.name}: {error}") from None
        return before, after


BUGS = (
    Bug(
        "undetermined_landmark",
        "one landmark by bearing alone makes the whole problem singular",
        (
            Change(
                "slam/landmarks/determination.py",
                "why_undetermined",
                "return '' if candidate.places else original(config, space, solver, candidate, glances)",
            ),
        ),
        ("test_pipeline_kinds.py::test_G3_a_landmark_seen_by_bearing_from_one_place_waits_and_says_why",),
    ),
    Bug(  # all of the check: a cost that is not finite fails its second half, too
        "unchecked_solution",
        "a solve that returns what is not finite counts as done",
        (Change("slam/failure_guard.py", "FailureGuard._refuse_absurd", "return"),),
        (
            "test_solver_faults.py::"
            "test_T14_whatever_fails_at_any_solve_the_last_good_estimate_stays_and_soon_one_succeeds[6]",
        ),
    ),
    Bug(  # in two layers: the first takes what is all zero for unknown, the second would refuse it
        "any_covariance",
        "a covariance that is zero or not positive definite is taken as it is",
        (
            Change("messages/inputs/source.py", "InputContext.checked", "return tuple(block.ravel().tolist())"),
            Change("messages/inputs/checks.py", "covariance", "return block, []"),
        ),
        (
            "test_message_cases.py::test_A7_zero_covariance_means_unknown",
            "test_message_cases.py::test_A9_a_covariance_that_is_not_positive_definite",
        ),
    ),
    Bug(  # of two: what is singular in the eyes of the graph is mended after this
        "no_condition_limit",
        "odometry that is too sure of itself breaks the factorisation",
        (
            Change("measurements/edge_noise.py", "LEAST_M2, LEAST_RAD2", "0.0, 0.0"),
            Change("measurements/edge_noise.py", "_FINEST", "0.0"),
        ),
        (
            "test_graph_cases.py::"
            "test_A12_however_certain_odometry_says_it_is_its_edges_are_not_and_what_they_are_part_of_is_solved",
        ),
    ),
    Bug(  # below the node, whose worker would count and go on without a solution
        "fatal_solve",
        "a solve that raises ends the node",
        (Change("slam/failure_guard.py", "FailureGuard._fail", "raise error"),),
        (
            "test_graph_cases.py::"
            "test_G7_where_nothing_that_has_come_is_to_blame_the_last_good_estimate_is_held_until_it_heals",
        ),
    ),
    Bug(  # below the node, where clock and stamps both tell of a jump
        "ignored_time_jump",
        "after time has jumped back all that comes is refused as late",
        (Change("slam/frontend/keyframe_frontend.py", "KeyframeFrontend.forget_time", "pass"),),
        ("test_timing_cases.py::test_B7_after_a_jump_of_time_what_is_older_than_the_map_is_used_and_begins_a_segment",),
    ),
    Bug(
        "written_over",
        "results are written straight over those of before",
        (
            Change(
                "runs/recorder.py",
                "_put",
                "(folder / name).write_bytes(text.encode())\nreturn checksum(text.encode())",
            ),
        ),
        ("test_journal.py::test_T11_a_crash_at_any_call_that_reaches_the_disk_loses_nothing_that_was_told",),
    ),
    Bug(
        "journal_at_the_end",
        "what was told is not on the disk when the node is killed",
        (Change("runs/recorder.py", "RunRecorder.flush", "return"),),
        ("test_journal.py::test_T11_a_crash_at_any_call_that_reaches_the_disk_loses_nothing_that_was_told",),
    ),
    Bug(
        "unchecked_chunks",
        "a damaged recording reads well, with other messages",
        (
            Change(
                "recordings/mcap_records.py",
                "_inside",
                "from dataclasses import replace\nreturn original(replace(chunk, uncompressed_crc=0))",
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
            Change("config/robust.py", "RobustConfig.decide", "setting(False, 'planted')"),
            Change("config/robust.py", "RobustConfig.loss", "setting('none', 'planted', choices=LOSSES)"),
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
            [*command, *map(test_path, tests)],
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

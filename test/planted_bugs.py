"""Ten ways in which such systems are known to fail, put into a copy of this one, one at a time: tests must see each.

``python test/planted_bugs.py [NAME ...]``: in the copy the tests pass as they are and fail with each bug.
"""

import ast
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from dataclasses import dataclass
from pathlib import Path

from places import ROOT, test_path

NOT_COPIED = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info")
NOT_COPIED_OF_ROOT = {"benchmarks", "build", "install", "log", "runs", "soak"}
LIMIT_S, FIRST_LIMIT_S = 300, 1200  # the first compiles the kernels of the copy


def changed(text, file, symbol, instead):
    """A source in which a name is something else. Raises LookupError where the symbol is not in it, once.

    ``symbol`` is a name in the module, or class and name: of a function or method, and ``instead`` its body, in which
    ``original`` is the function as it was; or of what a value is assigned to, and it is the value.
    """
    nodes = [ast.parse(text)]
    for name in symbol.split("."):
        nodes = [one for node in nodes for one in node.body if name in _names(one)]
    if len(nodes) != 1:
        raise LookupError(f"{file} has {symbol} {len(nodes)} times, not once: was it renamed or moved?")
    (node,) = nodes
    if isinstance(node, ast.Assign | ast.AnnAssign):
        lines = text.encode().splitlines(keepends=True)
        value, first, last = node.value, node.value.lineno - 1, node.value.end_lineno - 1
        start, end = lines[first][: value.col_offset], lines[last][value.end_col_offset :]
        lines[first : last + 1] = [start + instead.encode() + end]
        return b"".join(lines).decode()
    if node.decorator_list:
        raise LookupError(f"{file}: {symbol} has a decorator, which would be lost")
    for argument in ast.walk(node.args):
        if isinstance(argument, ast.arg):
            argument.annotation = None
    planted = f"def planted({ast.unparse(node.args)}):\n{textwrap.indent(instead, '    ')}\nreturn planted"
    return f"{text}\n\ndef _plant(original):\n{textwrap.indent(planted, '    ')}\n\n\n{symbol} = _plant({symbol})\n"


def _names(node):
    """What a statement defines."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    if isinstance(node, ast.AnnAssign) and node.value is not None:
        return {ast.unparse(node.target)}
    return {ast.unparse(target).strip("()") for target in node.targets} if isinstance(node, ast.Assign) else set()


@dataclass(frozen=True)
class Bug:
    """A fault, what happens elsewhere, and what must see it."""

    name: str
    finding: str
    changes: dict[str, str]  # "file of the package: symbol", and what that is instead
    tests: tuple[str, ...]  # each of which must fail

    def planted(self, root):
        """The files that change, by what is in them, and what is to be."""
        before, after = {}, {}
        for place, instead in self.changes.items():
            name, symbol = place.split(": ")
            file = root / "graph_slam_ros" / name
            if not file.is_file():
                raise LookupError(f"{self.name}: there is no {name}: was it renamed or moved?")
            before.setdefault(file, file.read_text(encoding="utf-8"))
            after[file] = changed(after.get(file, before[file]), f"{self.name}: {name}", symbol, instead)
        return before, after


CRASH = "test_journal.py::test_T11_P1_P2_a_crash_at_any_call_that_reaches_the_disk_loses_nothing_that_was_told"
FLIPPED = "test_T9_F3_a_flipped_bit_gives_no_record_that_was_not_written_and_none_after_a_gap"
HELD = "test_G7_where_nothing_that_has_come_is_to_blame_the_last_good_estimate_is_held_until_it_heals"
CERTAIN = "test_A12_however_certain_odometry_says_it_is_its_edges_are_not_and_what_they_are_part_of_is_solved"
STAYS = "test_T14_whatever_fails_at_any_solve_the_last_good_estimate_stays_and_soon_one_succeeds[6]"
BEGINS = "test_B7_after_a_jump_of_time_what_is_older_than_the_map_is_used_and_begins_a_segment"
_PLACED = "return '' if found else original(space, solver, seen, glances, found)"
_UNCHECKED = "from dataclasses import replace\nreturn original(replace(chunk, uncompressed_crc=0))"
_OVER = "(folder / name).write_bytes(text.encode())\nreturn checksum(text.encode())"
BUGS = (
    Bug(
        "undetermined_landmark",
        "one landmark by bearing alone makes the whole problem singular",
        {"slam/landmarks/triangulation.py: why_undetermined": _PLACED},
        ("test_pipeline_kinds.py::test_G3_a_landmark_seen_by_bearing_from_one_place_waits_and_says_why",),
    ),
    Bug(  # all of the check: a cost that is not finite fails its second half, too
        "unchecked_solution",
        "a solve that returns what is not finite counts as done",
        {"slam/failure_guard.py: FailureGuard._refuse_absurd": "return"},
        (f"test_solver_faults.py::{STAYS}",),
    ),
    Bug(  # in two layers: the first takes what is all zero for unknown, the second would refuse it
        "any_covariance",
        "a covariance that is zero or not positive definite is taken as it is",
        {
            "messages/inputs/source.py: InputContext.checked": "return tuple(block.ravel().tolist())",
            "messages/inputs/checks.py: covariance": "return block, []",
        },
        (
            "test_message_cases.py::test_A7_zero_covariance_means_unknown",
            "test_message_cases.py::test_odometry_that_cannot_be_used_is_refused_and_counted",
        ),
    ),
    Bug(  # of two: what is singular in the eyes of the graph is mended after this
        "no_condition_limit",
        "odometry that is too sure of itself breaks the factorisation",
        {"measurements/edge_noise.py: LEAST_M2, LEAST_RAD2": "0.0, 0.0", "measurements/edge_noise.py: _FINEST": "0.0"},
        (f"test_graph_cases.py::{CERTAIN}",),
    ),
    Bug(  # below the node, whose worker would count and go on without a solution
        "fatal_solve",
        "a solve that raises ends the node",
        {"slam/failure_guard.py: FailureGuard._fail": "raise error"},
        (f"test_graph_cases.py::{HELD}",),
    ),
    Bug(  # below the node, where clock and stamps both tell of a jump
        "ignored_time_jump",
        "after time has jumped back all that comes is refused as late",
        {"slam/frontend/keyframe_frontend.py: KeyframeFrontend.forget_time": "pass"},
        (f"test_timing_cases.py::{BEGINS}",),
    ),
    Bug(
        "written_over", "results are written straight over those of before", {"runs/recorder.py: _put": _OVER}, (CRASH,)
    ),
    Bug(
        "journal_at_the_end",
        "what was told is not on the disk when the node is killed",
        {"runs/recorder.py: RunRecorder.flush": "return"},
        (CRASH,),
    ),
    Bug(
        "unchecked_chunks",
        "a damaged recording reads well, with other messages",
        {"recordings/mcap_records.py: _inside": _UNCHECKED},
        (
            "test_file_cases.py::test_F3_a_flipped_bit_in_a_chunk_costs_that_chunk_alone_and_is_told",
            f"test_journal.py::{FLIPPED}",
        ),
    ),
    Bug(  # both: what decides protects without a loss, and a loss without decisions
        "every_closure_believed",
        "false closures destroy the map",
        {
            "config/pipeline.py: RobustConfig.decide": "setting(False, 'planted')",
            "config/pipeline.py: RobustConfig.loss": "setting('none', 'planted', choices=LOSSES)",
        },
        ("test_decisions.py::test_G10_false_closures_pull_nothing_and_all_true_ones_stay",),
    ),
)


def _not_copied(folder, names):
    return NOT_COPIED(folder, names) | (NOT_COPIED_OF_ROOT & set(names) if Path(folder) == ROOT else set())


def ended(root, tests, limit_s):
    """Run tests of a copy in a process of its own: its exit code (None: it took too long), and the last lines."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rf", "--tb=no"]
    environment = {name: value for name, value in os.environ.items() if name != "GRAPH_SLAM_SOAK"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
    environment |= {"PYTHONDONTWRITEBYTECODE": "1", "GRAPH_SLAM_CACHE": str(root / "cache")}
    words, options = [*command, *map(test_path, tests)], {"cwd": root, "env": environment, "start_new_session": True}
    with (
        (root / "output.txt").open("w") as output,
        subprocess.Popen(words, stdout=output, stderr=subprocess.STDOUT, **options) as child,
    ):
        try:
            code = child.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)  # with what it has begun
    said = (root / "output.txt").read_text()
    return code, "\n".join(said.splitlines()[-len(tests) - 3 :])


def caught(root, bug):
    """Whether every test of a bug fails, by what it looks at: a bug that was badly planted ends in another way."""
    start = time.monotonic()
    before, after = bug.planted(root)
    try:
        for file, text in after.items():
            file.write_text(text, encoding="utf-8")
        code, said = ended(root, bug.tests, LIMIT_S)
    finally:
        for file, text in before.items():
            file.write_text(text, encoding="utf-8")
    failed = " failed" in said and not re.search(r"passed|skipped|\d error|(Import|Name|Syntax)Error", said)
    verdict = "caught" if code == 1 and failed else "NOT CAUGHT"
    print(f"{verdict} {bug.name} ({bug.finding}), {time.monotonic() - start:.0f} s:\n{said}", flush=True)
    return verdict == "caught"


def main(*names):
    """Plant all bugs, or those of these names; returns the exit code."""
    if unknown := set(names) - {bug.name for bug in BUGS}:
        raise SystemExit(f"no bug is called {', '.join(sorted(unknown))}; there are {', '.join(b.name for b in BUGS)}")
    bugs = [bug for bug in BUGS if bug.name in (names or {bug.name for bug in BUGS})]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "copy"
        shutil.copytree(ROOT, root, ignore=_not_copied)
        tests = dict.fromkeys(test for bug in bugs for test in bug.tests)
        code, said = ended(root, tests, FIRST_LIMIT_S)
        print(f"without any bug: {said}", flush=True)
        if code != 0 or " passed" not in said or "skipped" in said:
            return 1
        count = sum(caught(root, bug) for bug in bugs)
    print(f"RELIABILITY planted_bugs tried={len(bugs)} caught={count} failed={len(bugs) - count}")
    return int(count < len(bugs))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

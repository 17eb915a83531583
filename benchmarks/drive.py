"""One contender driving through one problem, pose by pose, under the clock. Runs in a process of its own."""

import contextlib
import gc
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks import contenders
from benchmarks.problem import Array, Problem, Step
from graph_slam_ros.lie import se2, se3, so3

_REHEARSED = 300  # poses that are driven before the clock runs, so that code is loaded and compiled


@dataclass(slots=True)
class Drive:
    """How it went.

    Attributes
    ----------
    step_s : CPU time of each step
    poses, landmarks : the estimate after the last step
    peak_bytes : resident memory at its highest during the drive, above that before the first pose
    fault : why it ended early; empty where it did not
    """

    step_s: Array
    poses: Array = field(default_factory=lambda: np.empty(0))
    landmarks: Array = field(default_factory=lambda: np.empty(0))
    peak_bytes: int = 0
    fault: str = ""


def drive(name: str, problem: Problem, read_path: bool, patience_s: float) -> Drive:
    """Drive through a problem.

    Parameters
    ----------
    read_path : read all poses after each step; else the newest alone
    patience_s : CPU time after which it is called off
    """
    _through(name, problem.prefix(_REHEARSED), read_path, patience_s)
    return _through(name, problem, read_path, patience_s)


def _through(name: str, problem: Problem, read_path: bool, patience_s: float) -> Drive:
    contender = contenders.online(name, problem)
    steps = list(zip(problem.steps(), contender.prepared(problem).steps(), strict=True))
    step_s = np.zeros(len(steps))
    gc.collect()
    gc.freeze()  # what is there already would be searched for garbage again and again
    before = _memory(peak=False)
    spent, fault = 0.0, ""
    for k, (step, given) in enumerate(steps):
        try:
            pose, landmarks = _predicted(contender, step, problem)
            begin = time.process_time()
            contender.take(given, pose, landmarks)
            _ = contender.path() if read_path else contender.pose(k)
            step_s[k] = time.process_time() - begin
        except Exception as error:  # whatever a library throws is its result
            reason = next(filter(None, map(str.strip, str(error).splitlines())), type(error).__name__)
            return Drive(step_s[:k], fault=f"throws at pose {k}: {reason}")
        spent += step_s[k]
        if spent > patience_s:
            fault = f"called off at pose {k} after {spent:.0f} s"
            break
    peak = _memory(peak=True) - before
    return Drive(step_s[: k + 1], *contender.estimate(), peak, fault)


def _predicted(contender: contenders.Online, step: Step, problem: Problem) -> tuple[Array, Array]:
    """Where the new pose and the new landmarks are expected, from the newest estimate of what they are seen from."""
    group = se2 if problem.planar else se3
    if step.parent < 0:
        pose = tuple(problem.poses[0].tolist())
    else:
        motion = tuple(step.motion.tolist())
        parent = tuple(contender.pose(step.parent).tolist())
        pose = group.compose(parent, motion if step.forward else group.inverse(motion))
        if not problem.planar:  # rounding would grow from pose to pose
            pose = (*pose[:3], *so3.normalize(pose[3:]))
    points = [se2.act(pose, seen) for seen in step.sightings.measured[step.first].tolist()]
    return np.array(pose), np.array(points).reshape(-1, 2)


def _memory(peak: bool) -> int:
    """Resident bytes, now or at their highest since this was last asked for now.

    The kernel's own account of this process: ``ru_maxrss`` would count the parent's pages as well, as of the fork.
    """
    if not peak:
        with contextlib.suppress(OSError):  # without, the peak is that since the process began
            Path("/proc/self/clear_refs").write_text("5")
    status = Path("/proc/self/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("VmHWM" if peak else "VmRSS"))
    return 1024 * int(line.split()[1])

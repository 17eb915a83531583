"""One contender driving through one problem, pose by pose, under the clock. Runs in a process of its own."""

import gc
import time
from typing import Any

import numpy as np

from benchmarks import contenders
from benchmarks.contenders import Solved
from benchmarks.problem import Array, Problem, Step
from graph_slam_ros.lie import se2, se3, so3

_REHEARSED = 300  # poses that are driven before the clock runs, so that code is loaded and compiled
_PATIENCE_S = 600.0  # of CPU time, after which a drive is called off


def drive(name: str, problem: Problem, read_path: bool) -> Solved:
    """Drive through a problem, and read all poses after each step, or the newest alone."""
    _through(name, problem.prefix(_REHEARSED), read_path)
    return _through(name, problem, read_path)


def _through(name: str, problem: Problem, read_path: bool) -> Solved:
    contender = contenders.online(name, problem)
    steps = list(zip(problem.steps(), contender.prepared(problem).steps(), strict=True))
    step_s = np.zeros(len(steps))
    gc.collect()
    gc.freeze()  # what is there already would be searched for garbage again and again
    spent, fault = 0.0, ""
    for k, (step, given) in enumerate(steps):
        try:
            pose, landmarks = predicted(contender, step, problem)
            begin = time.process_time()
            contender.take(given, pose, landmarks)
            _ = contender.path() if read_path else contender.pose(k)
            step_s[k] = time.process_time() - begin
        except Exception as error:  # whatever a library throws is its result
            reason = next(filter(None, map(str.strip, str(error).splitlines())), type(error).__name__)
            return Solved(step_s[:k], fault=f"throws at pose {k}: {reason}")
        spent += step_s[k]
        if spent > _PATIENCE_S:
            fault = f"called off at pose {k} after {spent:.0f} s"
            break
    return Solved(step_s[: k + 1], *contender.estimate(), fault)


def predicted(contender: Any, step: Step, problem: Problem) -> tuple[Array, Array]:
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

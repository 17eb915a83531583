"""One job of a fleet: a recording with a configuration, replayed and scored, to one row of the table.

It runs in a process of its own, with a limit of memory. A row says what is wrong with the recording, or with the
machine: then the job is begun again.
"""

import contextlib
import ctypes
import errno
import hashlib
import json
import os
import platform
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graph_slam_ros.config.config import flatten
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.files import read_bytes
from graph_slam_ros.tools.fleet.recordings import local_copy
from graph_slam_ros.tools.fleet.store import ERRORS, JOBS, REPORT, RUN, Row, keep

if TYPE_CHECKING:
    from graph_slam_ros.config import Config

_HASHED = ("graph.g2o", "ledger.csv", "path.tum", "landmarks.csv")
_OF_THE_MACHINE = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.ESTALE, errno.EMFILE, errno.ENFILE}
_PARTS = 40
_PR_SET_PDEATHSIG = 1  # of Linux: the signal that comes when the parent ends


@dataclass(frozen=True, slots=True)
class Job:
    """A recording with a configuration.

    Attributes
    ----------
    key : its name, of the hashes of all that its result depends on
    url, recording : where the recording is, and its short name
    setting, values : the configuration in words, and parameters by name
    truth : as ``evaluate --truth``; empty without
    out : the folder of the fleet
    limit_s : seconds after which it is ended
    memory : bytes that it may use in addition to what its process has; 0 without limit
    with_report : write a page on the run
    """

    key: str
    url: str
    recording: str
    setting: str
    values: Mapping[str, Any]
    truth: str
    out: str
    limit_s: float
    memory: int
    with_report: bool


def run_job(job: Job) -> Row:
    """Run a job; returns its row, which is in the store, too; with ``retry`` it is not, and the machine failed."""
    try:
        made = _made(job)
        try:
            row = _head(job) | {"worker": platform.node()}
            with _memory_limit(job.memory):
                try:
                    row |= _results(job, made)
                except (GraphSlamError, MemoryError, SystemError, OSError) as error:
                    row |= {"state": "failed", "reason": _reason(job, error)}
            keep(Path(job.out), job.key, made, row)
        finally:
            shutil.rmtree(made, ignore_errors=True)
    except Exception as error:
        what = str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        return _head(job) | {"state": "failed", "reason": what, "retry": True}
    return row


def _made(job: Job) -> Path:
    """A new folder for the results, which is renamed when they are whole."""
    return Path(tempfile.mkdtemp(prefix=f".{job.key}.", dir=Path(job.out) / JOBS))


def _head(job: Job) -> Row:
    return {"key": job.key, "recording": job.recording, "setting": job.setting, "url": job.url, "truth": job.truth}


def failed(job: Job, reason: str) -> Row:
    """Return the row of a job that did not end, and write it where there is room."""
    row = _head(job) | {"state": "failed", "reason": reason, "retry": True}
    with contextlib.suppress(OSError):  # without the row it is run again, too
        keep(Path(job.out), job.key, _made(job), row)
    return row


def _reason(job: Job, error: BaseException) -> str:
    """The reason why a recording cannot be used; an error of the machine is raised instead, also one behind another."""
    if isinstance(error, MemoryError | SystemError) or getattr(error, "errno", None) == errno.ENOMEM:  # of C code
        return f"out of memory: more than {job.memory / 2**20:.0f} MiB (--memory)"
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in _OF_THE_MACHINE:
            raise OSError(cause.errno, os.strerror(cause.errno), job.out) from None
        cause = cause.__cause__ or cause.__context__
    if isinstance(error, OSError):
        raise error
    return " ".join(str(error).split())


@contextlib.contextmanager
def _memory_limit(memory: int) -> Iterator[None]:
    """Let allocations fail beyond a limit; 0 is none."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    if memory:
        limit = _status_bytes("VmData") + memory
        resource.setrlimit(resource.RLIMIT_DATA, (limit if before[1] < 0 else min(limit, before[1]), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _status_bytes(name: str) -> int:
    with contextlib.suppress(OSError), open("/proc/self/status") as lines:
        for line in lines:
            if line.startswith(f"{name}:"):
                return int(line.split()[1]) * 1024
    return 0


def _results(job: Job, made: Path) -> Row:
    from graph_slam_ros.runs.outcome import shortcomings
    from graph_slam_ros.runs.replay import replay

    begun = time.process_time()
    with tempfile.TemporaryDirectory(prefix="graph_slam_fleet_") as scratch:
        source = local_copy(job.url, Path(scratch))
        config, (odometry, landmarks) = _inputs(job, source)
        done = replay(source, made / RUN, config, odometry=odometry, landmarks=landmarks)
        row, lost = columns(done.summary), [*shortcomings(done.summary), *done.losses]
        if job.truth:
            try:
                row |= _scores(made / RUN, job.truth)
            except GraphSlamError as error:
                lost.append(f"not compared with the truth: {error}")
    if not done.summary["keyframes"]:
        raise GraphSlamError("no odometry of it could be used: graph_slam info says what is in it")
    if job.with_report:
        from graph_slam_ros.tools.report.contents import read_contents
        from graph_slam_ros.tools.report.page import plotly, write_report

        write_report(read_contents(made / RUN), plotly(), made / REPORT)
    return row | {
        "state": "incomplete" if lost else "done",
        "reason": " ".join(lost[0].split()) if lost else "",
        "inputs": config.inputs.names,
        "cpu_s": time.process_time() - begun,
        "memory_mib": _status_bytes("VmHWM") / 2**20,
        "map_hash": _map_hash(made / RUN),
    }


def _inputs(job: Job, recording: Path) -> tuple["Config", tuple[str | None, str | None]]:
    """The configuration, and topics of odometry and landmarks where ``info`` suggests other inputs than the usual."""
    from graph_slam_ros.config import Config
    from graph_slam_ros.runs.suggestion import suggestion_for_other_types

    config = Config.from_mapping(dict(job.values))
    found = suggestion_for_other_types(recording, config)
    if found is None:
        return config, (None, None)
    return Config.from_mapping(found.settings | config.differing), (
        found.topics.get("odom"),
        found.topics.get("detections"),
    )


def columns(summary: Mapping[str, Any]) -> Row:
    """The columns that come from the summary of a run."""
    row: Row = {name: summary[name] for name in ("keyframes", "landmarks", "sightings", "edges", "span_s", "chi2")}
    for label, one in summary["classes"].items():
        dof = one.get("dof", one["residuals"])
        row[f"chi2_per_residual.{label}"] = one["chi2"] / dof if dof else None
    for source, counts in summary["counters"].items():
        row |= {f"counted.{source}.{reason}": times for reason, times in counts.items()}
    for name, counts in summary["inputs"].items():
        row |= {f"input.{name}.{what}": counts.get(what) for what in ("received", "used", "believed")}
    return row


def _scores(run: Path, truth: str) -> Row:
    from graph_slam_ros.analysis.evaluation import dimensions_of, evaluate, input_topics, scored_drive
    from graph_slam_ros.analysis.path_error import matched
    from graph_slam_ros.analysis.trajectories import read_truth

    known = read_truth(truth, "", input_topics(run))
    scores = evaluate(run, known).as_dict()
    path = scored_drive(run, known.trajectory).estimate
    errors = matched(path, known.trajectory, dimensions_of(run)).position_errors_m
    parts = np.array_split(errors, min(len(errors), _PARTS))
    flat = dict(flatten(scores))
    drift = scores["drift"].get("per_m") or {}
    angle = scores.get("heading_rad") or scores.get("angle_rad") or {}
    return {
        "rmse_m": flat.get("position_m.rmse"),
        "max_m": flat.get("position_m.max"),
        "angle_rad": angle.get("rmse"),
        "rpe_m_per_m": (drift.get("position_m_per_m") or {}).get("rmse"),
        "map_rmse_m": flat.get("map_m.rmse"),
        "nees": flat.get("consistency.poses.mean"),
        ERRORS: [round(float(np.sqrt(np.mean(part**2))), 4) for part in parts],
        "odometry_rmse_m": flat.get("odometry.position_m.rmse"),
    }


def _map_hash(run: Path) -> str:
    """The hash of a run's graph, verdicts, path and landmarks: equal for equal results."""
    digest = hashlib.sha256()
    for name in _HASHED:
        digest.update(read_bytes(run / name))
    return digest.hexdigest()[:16]


def _main() -> None:
    """Run the job of standard input, and write its row to standard output; what it prints goes to standard error."""
    with contextlib.suppress(OSError, AttributeError):  # nobody needs the job when its worker has ended
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    # Now: imports under a limit of memory fail in ways of their own.
    import graph_slam_ros.analysis.evaluation
    import graph_slam_ros.runs.replay  # noqa: F401

    with contextlib.redirect_stdout(sys.stderr):
        row = run_job(Job(**json.load(sys.stdin)))
    sys.stdout.write(json.dumps(row))


if __name__ == "__main__":
    _main()

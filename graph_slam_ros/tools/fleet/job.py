"""One job of a fleet: a recording with a configuration, replayed and scored, to one row of the table.

It runs in a worker's process, with a limit of time and of memory. What is wrong with the recording is a row with the
reason. What is wrong with the machine is an exception, or the end of the process: then it is begun again elsewhere.
"""

import contextlib
import errno
import faulthandler
import hashlib
import os
import platform
import resource
import shutil
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
from graph_slam_ros.tools.fleet.store import (
    ATTEMPTS,
    ERRORS,
    JOBS,
    MOST_ATTEMPTS,
    REPORT,
    RUN,
    Row,
    begin_attempt,
    keep,
    traces,
)

if TYPE_CHECKING:
    from graph_slam_ros.config import Config

_HASHED = ("graph.g2o", "ledger.csv", "path.tum", "landmarks.csv")
_OF_THE_MACHINE = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.ESTALE, errno.EMFILE, errno.ENFILE}
_PARTS = 40
_TIMEOUT = "Timeout ("  # how faulthandler begins


@dataclass(frozen=True, slots=True)
class Job:
    """A recording with a configuration.

    Attributes
    ----------
    key : its name, of the hashes of all that its result depends on
    url, recording : where the recording is, and its short name
    setting : the configuration in words
    values : parameters by name
    truth : as ``evaluate --truth``; empty without
    out : the folder of the fleet
    limit_s : seconds after which it is ended
    memory : bytes that it may use in addition to what the worker has; 0 without limit
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
    """Run a job; returns its row, which is in the store, too.

    Raises
    ------
    OSError
        The disk or the store fails: try it elsewhere.
    """
    out = Path(job.out)
    attempt = begin_attempt(out, job.key)
    if attempt > MOST_ATTEMPTS:
        return failed(job, why_it_died(out, job.key))
    made = Path(tempfile.mkdtemp(prefix=f".{job.key}.", dir=out / JOBS))
    try:
        row = head(job) | {"attempts": attempt, "worker": platform.node()}
        with open(out / ATTEMPTS / f"{job.key}.{attempt}", "w") as trace, _limits(job, trace):
            try:
                row |= _results(job, made)
            except (GraphSlamError, MemoryError) as error:
                _check_machine(out, error)
                row |= {"state": "failed", "reason": _reason(job, error)}
        keep(out, job.key, made, row)
    finally:
        shutil.rmtree(made, ignore_errors=True)
    return row


def report_on(job: Job) -> Row:
    """Write the report on a run that is there; returns which one.

    Raises
    ------
    OSError
        The disk or the store fails.
    """
    from graph_slam_ros.tools.report import write_report

    folder = Path(job.out) / JOBS / job.key
    write_report(folder / RUN, folder / REPORT)
    return head(job) | {"state": "done"}


def head(job: Job) -> Row:
    """Return the columns that say which job it is."""
    return {"key": job.key, "recording": job.recording, "setting": job.setting, "url": job.url, "truth": job.truth}


def _check_machine(out: Path, error: BaseException) -> None:
    """Raise the error of the operating system behind ``error`` if it says nothing about the recording."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in _OF_THE_MACHINE:
            raise OSError(cause.errno, os.strerror(cause.errno), str(out)) from None
        cause = cause.__cause__ or cause.__context__


def failed(job: Job, reason: str) -> Row:
    """Return the row of a job that did not end, and write it where there is room."""
    row = head(job) | {"state": "failed", "reason": reason, "attempts": MOST_ATTEMPTS, "retry": True}
    with contextlib.suppress(OSError):  # without the row it is run again, too
        made = Path(tempfile.mkdtemp(prefix=f".{job.key}.", dir=Path(job.out) / JOBS))
        keep(Path(job.out), job.key, made, row)
    return row


def why_it_died(out: Path, key: str) -> str:
    """The reason why the process of a job ended, from what its attempts left."""
    if any(_TIMEOUT in trace for trace in traces(out, key)):
        return f"took longer than the limit of time, {MOST_ATTEMPTS} times"
    return f"its process ended {MOST_ATTEMPTS} times: killed, out of memory, or a crash"


def _reason(job: Job, error: BaseException) -> str:
    if isinstance(error, MemoryError):
        return f"out of memory: more than {job.memory / 2**20:.0f} MiB (--memory)"
    return " ".join(str(error).split())


@contextlib.contextmanager
def _limits(job: Job, trace: Any) -> Iterator[None]:
    """End the process after the limit of time; let allocations fail beyond the limit of memory."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    faulthandler.dump_traceback_later(job.limit_s, exit=True, file=trace)  # a thread, which needs memory itself
    if job.memory:
        limit = _status_bytes("VmData") + job.memory
        resource.setrlimit(resource.RLIMIT_DATA, (limit if before[1] < 0 else min(limit, before[1]), before[1]))
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _status_bytes(name: str) -> int:
    """A size of this process, from Linux."""
    with contextlib.suppress(OSError), open("/proc/self/status") as lines:
        for line in lines:
            if line.startswith(f"{name}:"):
                return int(line.split()[1]) * 1024
    return 0


def _results(job: Job, made: Path) -> Row:
    """Replay, score and report; the columns of the row."""
    from graph_slam_ros.runs.outcome import shortcomings
    from graph_slam_ros.runs.replay import replay

    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # the peak of memory begins anew
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
        from graph_slam_ros.tools.report import write_report

        write_report(made / RUN, made / REPORT)
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
    from graph_slam_ros.runs.suggested_inputs import suggestion_for_other_types

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
    """The errors of a run against the truth."""
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

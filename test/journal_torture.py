"""A run is killed, cut short and denied the disk, again and again; what is left of it is judged each time.

``python journal_torture.py kills|crashes COUNT FOLDER`` does what forks: in a process of its own, which has no threads.
"""

import errno
import functools
import gc
import itertools
import json
import os
import random
import select
import shutil
import signal
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from reliability import times

import graph_slam_ros.runs.folder
import graph_slam_ros.runs.recorder
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import NEW, AppendedFile
from graph_slam_ros.measurements.types import from_record
from graph_slam_ros.node.session import Session
from graph_slam_ros.runs.folder import BEGUN, RunError, check_room, earlier_runs, is_run, run_config
from graph_slam_ros.runs.journal import read_ingest
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.slam import Config, Counters, GraphSlam
from graph_slam_ros.tools.simulation import measurements, simulate
from graph_slam_ros.warmup import warmup

RESULTS = ("graph.g2o", "graph_vertices.csv", "ledger.csv", "path.tum", "covariances.csv", "landmarks.csv", "run.json")
STATES = ("empty folder", "earlier run there", "after one save", "after a disk-full period")
STEPS, SAVES = 34, (20,)  # measurements, and after which of them is saved; once more at the end
UPDATED, SAVED, WRONG = b"u", b"s", b"!"
IS_LONG = times(False, True)
EVERY, FAILS_EVERY = times((6, 23), (1, 1))
"""Of the calls that reach the disk, at which it crashes, and which fail."""


def row(name, tried, faults, failed):
    """One line of the table of reliability; returns what failed."""
    print(f"RELIABILITY {name} tried={tried} faults={faults} failed={len(failed)}", flush=True)
    return failed


@functools.cache
def recorded():
    """What a simulated robot measures, in order."""
    return tuple(measurements(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=4.0)))


def config_of(folder, keep_earlier=0):
    return Config.from_mapping({"output.folder": str(folder), "output.keep_earlier": keep_earlier})


def drive(folder, tell, keep_earlier=0, before=lambda k: None):
    """A short run with three saves, as the node makes it: what it acknowledges is told as it does."""
    session = Session(config_of(folder, keep_earlier), Counters(), lambda *_: tell(UPDATED), lambda *_: None)
    for k, measurement in enumerate(recorded()[:STEPS]):
        before(k)
        session.ingest([measurement])
        if k + 1 in SAVES:
            session.save()
            tell(SAVED)
    session.finish()
    tell(SAVED)


# -- what is left ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reference:
    """The same run, undisturbed.

    Attributes
    ----------
    acknowledged : by update: how many records were accepted before it was told, and how many keyframes there were
    saved : by save: the bytes of each file of results
    """

    records: list
    acknowledged: list
    saved: list
    trajectory: np.ndarray

    @classmethod
    def of(cls, folder):
        saves = (folder.with_name(f"{folder.name}_save_{k}") for k in itertools.count())
        in_a_child(lambda tell: drive(folder, lambda what: what == SAVED and shutil.copytree(folder, next(saves))))
        there = sorted(folder.parent.glob(f"{folder.name}_save_*"))
        saved = [{name: (save / name).read_bytes() for name in RESULTS} for save in there]
        records = list(read_ingest(folder, losses := []))
        assert not losses
        assert len({state["run.json"] for state in saved}) == len(SAVES) + 1
        acknowledged, slam = replayed(records, config_of(folder))
        return cls(records, acknowledged, saved, slam.trajectory())

    def faults(self, folder, told, deep):
        """What is wrong with a folder that such a run has left, having told so much.

        Parameters
        ----------
        deep : also replay the journal
        """
        updates, saves = told.count(UPDATED), told.count(SAVED)
        check_room(folder, force=True)  # or nobody can start there again
        if not updates:
            return
        assert is_run(folder), "it is no run"
        run_config(folder)
        records = list(read_ingest(folder, []))
        assert records == self.records[: len(records)], "records that were not written"
        least, keyframes = self.acknowledged[updates - 1]
        assert len(records) >= least, f"{len(records)} records of {least} that were acknowledged"
        if deep:
            _, slam = replayed(records, run_config(folder))
            assert len(slam.keyframes) >= keyframes, f"{len(slam.keyframes)} keyframes of {keyframes}"
        for name in RESULTS:
            there = (folder / name).read_bytes() if (folder / name).is_file() else None
            before = ([BEGUN] if name == "run.json" else [None]) if not saves else []
            known = [state[name] for state in self.saved[max(saves - 1, 0) :]] + before
            if name == "run.json":  # when the journal is flushed, and CPU and memory, depend on the time
                there, *known = map(without_marks, (there or b"{}", *known))
            assert there in known, f"{name} is neither the old nor the new one"
        for earlier in earlier_runs(folder).values():
            list(read_ingest(earlier, []))


def without_marks(summary):
    """A run.json but for the marks of the recordings, and what the process has cost."""
    told = json.loads(summary)
    for name in ("recorded", "load"):
        told.pop(name, None)
    return told


def replayed(records, config):
    """(records and keyframes at each update, the pipeline)."""
    accepted, acknowledged = [], []
    slam = GraphSlam(config, accepted.append)
    for record in records:
        if slam.process(from_record(record)):
            acknowledged.append((len(accepted), len(slam.keyframes)))
    return acknowledged, slam


def judged(judge, *arguments):
    """What is wrong, in words; empty: nothing."""
    try:
        judge(*arguments)
    except (AssertionError, GraphSlamError, OSError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return ""


# -- children ----------------------------------------------------------------------------------------------------------


@dataclass
class Child:
    """A forked process that does the work; what it tells is heard through a pipe, and outlives it."""

    pid: int
    pipe: int
    told: bytes = b""

    @classmethod
    def doing(cls, work):
        reading, writing = os.pipe()
        tell = functools.partial(os.write, writing)  # before anything is made to fail
        pid = os.fork()
        if pid:
            os.close(writing)
            return cls(pid, reading)
        code = 1
        try:
            work(tell)
            code = 0
        except BaseException as error:
            tell(WRONG + f"{type(error).__name__}: {error}".encode())
        finally:
            os._exit(code)

    def hear(self, seconds):
        """Until it ends, or for so long; whether it has ended."""
        deadline = time.monotonic() + seconds
        while select.select([self.pipe], [], [], max(0.0, deadline - time.monotonic()))[0]:
            if not (some := os.read(self.pipe, 4096)):
                return True
            self.told += some
        return False

    def end(self, number=0):
        """Send a signal, hear the rest; returns how it ended."""
        if number:
            os.kill(self.pid, number)
        self.hear(60.0)
        os.close(self.pipe)
        status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        assert WRONG not in self.told, self.told.partition(WRONG)[2].decode()
        return status


def in_a_child(work):
    """Do it to its end."""
    child = Child.doing(work)
    child.hear(600.0)
    return child.end(), child.told


def naive(path, data):
    """As one would: over the old file."""
    path.write_bytes(data)


def drive_naively(folder, tell, keep_earlier):
    """The same with files that are written over the old ones, and a journal that is written when it is closed."""
    flush, close = AppendedFile.flush, AppendedFile.close

    def flush_and_close(self):
        flush(self)
        close(self)

    graph_slam_ros.runs.recorder.write_whole = graph_slam_ros.runs.folder.write_whole = naive
    AppendedFile.flush = AppendedFile.sync = lambda self: None
    AppendedFile.close = flush_and_close
    drive(folder, tell, keep_earlier)


def kills(count, root, work, name, deep_every):
    """Kill so many runs at random; each begins in what the one before has left. Returns what was wrong.

    Those that have acknowledged nothing yet are judged, too, but not counted: there was nothing to lose.
    """
    reference = Reference.of(root / f"{name}_reference")
    rng, folder, wrong, killed = random.Random(1), root / name, [], 0
    start = time.monotonic()
    in_a_child(lambda tell: work(folder, tell, 0))
    span = time.monotonic() - start
    while killed < count:
        keep = rng.choice((0, 0, 2))
        child = Child.doing(lambda tell, keep=keep: work(folder, tell, keep))
        if child.hear(rng.uniform(0.0, span)):
            span *= 0.95
        is_killed = child.end(signal.SIGKILL) == -signal.SIGKILL
        killed += is_killed and UPDATED in child.told
        if fault := judged(reference.faults, folder, child.told, killed % deep_every == 0):
            wrong += [f"kill {killed}: {fault}"]
            for file in folder.glob("*"):  # the next begins anew
                file.unlink()
    return wrong


# -- a disk that fails -------------------------------------------------------------------------------------------------

CONTROLS = 5  # rounds of kills in which the naive writer must have failed often enough
CALLS = ("open", "write", "pwrite", "fsync", "replace", "ftruncate")
ALSO_CRASHES = ("unlink", "rename", "mkdir")
KINDS = (errno.ENOSPC, errno.EIO, errno.EROFS, errno.EDQUOT, errno.EACCES, "short")


class Faulty:
    """Counts the calls that reach the disk below a folder, and lets one of them fail, or all from there on.

    Parameters
    ----------
    at : the number of the call; 0: none
    act : called with the number since then, the call's name, the real call and its arguments
    """

    def __init__(self, root, at, act, names=CALLS):
        self._root, self._act, self._names = str(root), act, names
        self._lock = threading.Lock()
        self._real = []
        self.at, self.count, self.fired = at, 0, 0

    def __enter__(self):
        for owner, name in [*((os, name) for name in self._names), (Path, "write_bytes")]:
            real = getattr(owner, name)
            self._real.append((owner, name, real))
            setattr(owner, name, self._counted(name, real))
        return self

    def __exit__(self, *_):
        for owner, name, real in self._real:
            setattr(owner, name, real)

    def _counted(self, name, real):
        def call(*arguments, **options):
            if not self.at or not (isinstance(arguments[0], int) or str(arguments[0]).startswith(self._root)):
                return real(*arguments, **options)
            with self._lock:
                self.count += 1
                since = self.count - self.at
            if since < 0:
                return real(*arguments, **options)
            self.fired += 1
            return self._act(since, name, real, arguments, options)

        return call

    def lift(self):
        """From now on all is well."""
        self.at = 0


def crashing(since, name, real, arguments, options):
    """In the middle of what is written, or before what cannot be half done."""
    if name in ("pwrite", "write_bytes"):
        first, data, *rest = arguments
        real(first, data[: len(data) // 2], *rest)
    os._exit(9)


def failing(kind, lasts):
    """Calls that fail, one or from there on; of a short write the first writes half, and then there is no room."""

    def act(since, name, real, arguments, options):
        if kind == "short" and since == 0:
            if name == "pwrite":
                fd, data, at = arguments
                return real(fd, data[: max(1, len(data) // 2)], at)
            return real(*arguments, **options)
        if since > (kind == "short") and not lasts:
            return real(*arguments, **options)
        number = errno.ENOSPC if kind == "short" else kind
        if name == "write_bytes":
            path, data = arguments
            real(path, data[: len(data) // 2])
        raise OSError(number, os.strerror(number))

    return act


def armed_at(state):
    """The step before which calls begin to count; None: before the first."""
    return {"after one save": SAVES[0], "after a disk-full period": 14}.get(state)


def full_for_a_while(state, faulty, k, then):
    """What is there before calls are counted, and the begin of that."""
    if state == "after a disk-full period" and k == 10:  # an update comes at 12
        faulty.at, faulty._act = faulty.count + 1, failing(errno.ENOSPC, True)
    if k == armed_at(state):
        faulty.count, faulty.fired, faulty.at, faulty._act = 0, 0, *then


def crashes(state, root):
    """A crash at one call that reaches the disk, a later one, ... until there are no more: (tried, wrong)."""
    reference = Reference.of(root / "reference")
    folder, wrong = root / "run", []
    for tried, n in enumerate(itertools.count(1, EVERY)):
        begin(folder, state)

        def work(tell, n=n):
            with Faulty(root, 0, crashing, CALLS + ALSO_CRASHES) as faulty:
                faulty.at = 0 if armed_at(state) else n
                drive(folder, tell, before=lambda k: full_for_a_while(state, faulty, k, (n, crashing)))

        code, told = in_a_child(work)
        if fault := judged(reference.faults, folder, told, tried % 8 == 0):
            wrong.append(f"{state}, call {n}: {fault}")
        if code == 0:
            return tried, wrong


def begin(folder, state):
    """A folder as a run may find it."""
    if state == "earlier run there" and folder.exists():
        return  # what the one before has left
    for file in folder.glob("*"):
        file.unlink()
    if state == "earlier run there":
        in_a_child(lambda tell: drive(folder, tell))


def errors(state, root, kinds_of):
    """One call after the other fails, or all from there on for a while: (tried, wrong, how often recording went on).

    Parameters
    ----------
    kinds_of : of the how manieth trial, what happens: kinds, and whether it lasts
    """
    reference = Reference.of(root / "reference")
    folder, wrong, tried, recovered = root / "run", [], 0, 0
    if state == "earlier run there":
        drive(folder, lambda what: None)
    for k, n in enumerate(itertools.count(1, FAILS_EVERY)):
        fired = 0
        for kind, lasts in kinds_of(k):
            if state != "earlier run there":
                for file in folder.glob("*"):
                    file.unlink()
            trial = Trial(reference, folder, state)
            if fault := judged(trial.go, n, failing(kind, lasts), kind):
                wrong.append(f"{state}, call {n}, {kind}{', lasting' if lasts else ''}: {fault}")
            tried, fired, recovered = tried + 1, fired + trial.fired, recovered + trial.has_recovered
        if not fired:
            return tried, wrong, recovered


class Trial:
    """One run on a disk that fails for a while: all that it is asked for is tried again when the disk is well."""

    def __init__(self, reference, folder, state):
        self._reference, self._folder, self._state = reference, folder, state
        self._told = []
        self.has_recovered = False

    def go(self, n, act, kind):
        files = set(os.listdir("/proc/self/fd"))
        with Faulty(self._folder, 0, act) as faulty:
            self._faulty = faulty
            faulty.at = 0 if armed_at(self._state) else n
            make = functools.partial(
                Session, config_of(self._folder), Counters(), lambda *_: None, lambda *told: self._told.append(told)
            )
            session = self._again(make)
            fails = []
            for k, measurement in enumerate(recorded()[:STEPS]):
                if self._state == "after a disk-full period" and k == armed_at(self._state):
                    assert session.recording_fails, "a full disk was not told of"
                    faulty.lift()
                    session.ingest([])
                full_for_a_while(self._state, faulty, k, (n, act))
                fails.append(session.recording_fails)
                session.ingest([measurement])
                if faulty.fired and k % 8 == 7 and armed_at(self._state) != k:
                    faulty.lift()
                if k + 1 in SAVES:
                    self._again(session.save)
            self._again(session.finish)
        fails.append(session.recording_fails)
        self.has_recovered = any(fails) and not fails[-1]
        assert not fails[-1], "it still says that recording fails"
        assert self._told or kind == "short" or not self.fired, "nobody was told"
        self._compare(session)
        assert set(os.listdir("/proc/self/fd")) <= files, "files were left open"

    @property
    def fired(self):
        return self._faulty.fired

    def _again(self, call):
        """When it fails, once more on a disk that is well."""
        try:
            return call()
        except RunError as error:
            self._told.append(error)
            assert not list(self._folder.glob(f"*{NEW}")), "a new file was left there"
            assert self._faulty.fired, error
            self._faulty.lift()
            return call()

    def _compare(self, session):
        losses, reference = [], self._reference
        records = list(read_ingest(self._folder, losses))
        assert not losses, losses
        assert measured(records) == measured(reference.records), "the journal is not complete"
        _, again = replayed(records, run_config(self._folder))
        assert np.array_equal(again.trajectory(), session.slam.trajectory()), "the journal gives another path"
        assert np.allclose(session.slam.trajectory(), reference.trajectory, rtol=0.0, atol=1e-6), "another path"
        assert not list(self._folder.glob(f"*{NEW}")), "a new file was left there"
        assert json.loads((self._folder / "run.json").read_text())["keyframes"] == len(session.slam.keyframes)


def measured(records):
    """Without what each further save asks the pipeline for."""
    return [record for record in records if record["type"] != "control"]


def warm(folder):
    """What is slow the first time is done before anybody is forked, without a thread."""
    warmup()
    recorder = RunRecorder(folder, Config())
    slam = GraphSlam(Config(), recorder.sink)
    for measurement in recorded()[:STEPS]:
        recorder.record(slam, slam.process(measurement))
    recorder.save(slam)
    replayed(list(read_ingest(folder, [])), run_config(folder))
    gc.collect()
    gc.freeze()  # the children share it


def main(what, count, folder):
    root, count = Path(folder), int(count)
    warm(root / "warm")
    if what == "kills":
        wrong = kills(count, root, drive, "kills", 1 if IS_LONG else 10)
        row("kill_9", count, count, wrong)
        control, rounds = [], 0
        while len(control) < count / 3 and rounds < CONTROLS:  # where few kills hit it while it has something to lose
            control += kills(count, root, drive_naively, f"naive{rounds}", 10)
            rounds += 1
        tried = rounds * count
        print(f"RELIABILITY kill_9_control tried={tried} faults={tried} failed={len(control)} (of {count / 3:.0f})")
        if len(control) < count / 3:
            wrong.append(f"the test is void: the naive writer failed in {len(control)} of {tried}")
    else:
        wrong, control, tried = [], [], 0
        for state in STATES[:count]:
            (root / state).mkdir()
            calls, some = crashes(state, root / state)
            tried, wrong = tried + calls, wrong + some
        row("crash_at_nth_call", tried, tried, wrong)
    print(*wrong[:20], *control[:5], sep="\n")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

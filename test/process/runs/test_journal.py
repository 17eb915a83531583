"""The journal: what was told outlives whatever ends the process, and a disk that fails loses nothing."""

import errno
import functools
import itertools
import json
import math
import os
import random
import shutil
import signal
import struct
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from reliability import tell, times
from rows import each

from graph_slam_ros.errors import FormatError, GraphSlamError
from graph_slam_ros.formats.durable import NEW
from graph_slam_ros.measurements.types import from_record, to_record
from graph_slam_ros.node.session import Session
from graph_slam_ros.recordings.mcap_records import MAGIC
from graph_slam_ros.runs import recorder as recorder_module
from graph_slam_ros.runs.folder import BEGUN, RunError, check_room, earlier_runs, is_run, run_config
from graph_slam_ros.runs.journal import RecordWriter, part_name, read_ingest
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.restore import map_of
from graph_slam_ros.slam import Config, Counters, GraphSlam, Odometry
from graph_slam_ros.tools.simulation import measurements, simulate

RESULTS = ("graph.g2o", "graph_vertices.csv", "ledger.csv", "path.tum", "covariances.csv", "landmarks.csv", "run.json")
STATES = ("empty folder", "earlier run there")
STEPS, SAVE = 34, 20  # measurements, and after which of them is saved; once more at the end
UPDATED, SAVED, WRONG = b"u", b"s", b"!"
IS_LONG = times(False, True)
EVERY, FAILS_EVERY = times((6, 11), (1, 1))
KILLS = times(10, 3_000)
"""Of the calls that reach the disk, at which it crashes, and which fail."""


@functools.cache
def recorded():
    """What a simulated robot measures, in order."""
    return tuple(measurements(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=4.0)))


def config_of(folder, keep_earlier=0):
    return Config.from_mapping({"output.folder": str(folder), "output.keep_earlier": keep_earlier})


def drive(folder, tell, keep_earlier=0):
    """A short run with three saves and many maps, as the node makes it: what it acknowledges is told as it does."""
    recorder_module._TAIL_S, recorder_module._BYTES_PER_S = 0.0, math.inf  # a map is often being written
    session = Session(config_of(folder, keep_earlier), Counters(), lambda *_: tell(UPDATED), lambda *_: None)
    for k, measurement in enumerate(recorded()[:STEPS]):
        session.ingest([measurement])
        if k + 1 == SAVE:
            session.save()
            tell(SAVED)
    session.finish()
    tell(SAVED)


CUTS, FLIPS = times((50, 60), (None, 5_000))  # None: at every byte


@dataclass(frozen=True)
class Part:
    """A file of a journal: its bytes, its records, and by chunk where it ends and how many records there are then."""

    data: bytes
    records: list
    flushed: list

    def whole(self, length):
        """How many records there are in whole flushes of so many bytes."""
        return max((count for end, count in self.flushed if end <= length), default=0)


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """A journal of four files, in chunks of three records."""
    folder, records, out = tmp_path_factory.mktemp("journal"), as_read(recorded()[:600]), []
    for number in range(4):
        some = records[150 * number : 150 * (number + 1)]
        writer = RecordWriter(file_of(folder, number))
        for k in range(0, len(some), 3):
            writer.write(some[k : k + 3])
        writer.end().close()
        data = file_of(folder, number).read_bytes()
        flushed = list(zip(chunk_ends(data), range(3, len(some) + 1, 3), strict=True))
        out.append(Part(data, some, flushed))
    return out


def file_of(folder, number):
    return folder / part_name("ingest", number)


def chunk_ends(data):
    """Where each chunk ends, by the lengths in the file alone."""
    at, ends = len(MAGIC), []
    while data[at] != Opcode.DATA_END:
        opcode, length = struct.unpack_from("<BQ", data, at)
        at += 9 + length
        ends += [at] if opcode == Opcode.CHUNK else []
    return ends


def laid_out(folder, some):
    for number, data in enumerate(some):
        file_of(folder, number).write_bytes(data)
    return folder


def spread(total, count):
    """So many places, evenly."""
    return range(total) if count >= total else [round(k * (total - 1) / (count - 1)) for k in range(count)]


def test_T9_F16_cut_anywhere_the_longest_prefix_of_whole_flushes_is_read(parts, tmp_path):
    sizes = [len(part.data) for part in parts]
    wrong, places = [], spread(sum(sizes), CUTS or sum(sizes))
    for k, place in enumerate(reversed(places)):
        number = next(n for n in range(len(parts)) if place < sum(sizes[: n + 1]))
        length, part = place - sum(sizes[:number]), parts[number]
        before = parts[:number] if k % 50 == 0 else []  # what is before makes no difference
        laid_out(tmp_path, [*(one.data for one in before), part.data[:length]])
        losses = []
        read = list(read_ingest(tmp_path, losses))
        expected = [record for one in before for record in one.records] + part.records[: part.whole(length)]
        if read != expected or not losses:
            wrong.append((number, length, len(read), len(expected), losses))
        for file in tmp_path.iterdir():
            file.unlink()
    tell("journal_cut", tried=len(places), failed=len(wrong))
    assert not wrong


def test_T9_F3_a_flipped_bit_gives_no_record_that_was_not_written_and_none_after_a_gap(parts, tmp_path):
    rng, wrong, untold = random.Random(3), [], 0
    for _ in range(FLIPS):
        number = rng.randrange(len(parts) - 1)
        part, after = parts[number], parts[number + 1]
        data, place, bit = bytearray(part.data), rng.randrange(len(part.data)), rng.randrange(8)
        data[place] ^= 1 << bit
        losses = []
        try:
            read = list(read_ingest(laid_out(tmp_path, [data, after.data]), losses))
        except FormatError as error:
            wrong.append((number, place, bit, str(error)))
            continue
        written = part.records + after.records
        is_all = read == written
        if read != written[: len(read)] or not (is_all or losses):
            wrong.append((number, place, bit, len(read), losses))
        untold += is_all and not losses
    assert untold < FLIPS / 2  # places that no record depends on: times, the index
    tell("journal_flipped", tried=FLIPS, failed=len(wrong))
    assert not wrong


def test_F18_a_kind_of_record_that_is_not_known_is_refused_by_its_name(tmp_path):
    RunRecorder(tmp_path / "run", Config()).close()
    journal = tmp_path / "run" / "ingest.mcap"
    journal.unlink()
    writer = RecordWriter(journal)
    writer.write([to_record(Odometry(1, (0.0, 0.0, 0.0))), {"type": "sonar", "stamp_ns": 2}])
    writer.end().close()
    with pytest.raises(FormatError, match="sonar"):
        replay(tmp_path / "run", tmp_path / "out")


def test_F18_a_channel_that_is_not_of_json_is_refused_and_other_records_of_mcap_are_passed_over(tmp_path):
    def journal(encoding):
        with (tmp_path / "ingest.mcap").open("wb") as stream:
            writer = Writer(stream, compression=CompressionType.ZSTD)
            writer.start()
            channel = writer.register_channel("odometry", encoding, writer.register_schema("a", "jsonschema", b"{}"))
            writer.add_metadata("of another", {"to be": "passed over"})
            writer.add_message(channel, 1, b'{"type":"odometry"}', 1, 0)
            writer.finish()
        return list(read_ingest(tmp_path, []))

    assert journal("json") == [{"type": "odometry"}]
    with pytest.raises(FormatError, match="cbor"):
        journal("cbor")


@each("end", ["save", "leave", "close"])
def test_P3_a_run_ends_while_a_flush_in_the_background_waits_for_its_turn(tmp_path, end):
    """The end waits for the disk, which has to be asked while the flush waits for the end."""
    recorder, slam = RunRecorder(tmp_path / "run", Config(), 1e-9), GraphSlam(Config())

    def ends():
        with recorder._writing:  # as an update holds it that ends just before
            recorder.accept(recorded()[0])
            recorder.flush_in_background()
            recorder.flush()
            {"save": lambda: recorder.save(slam), "leave": lambda: recorder.leave(0, 0, Counters())}.get(
                end, recorder.close
            )()

    thread = threading.Thread(target=ends, daemon=True)
    thread.start()
    thread.join(10.0)
    assert not thread.is_alive()
    assert len(list(read_ingest(tmp_path / "run", []))) == 1


def as_read(measurements):
    return [json.loads(json.dumps(to_record(m))) for m in measurements]


def test_P3_a_power_cut_finds_names_and_contents_on_the_disk_before_anything_hangs_on_them(tmp_path, monkeypatch):
    """What is renamed was synced before, its folder after; what was closed was synced as it is."""
    calls = []

    def noted(name, describe):
        real = getattr(os, name)

        def call(*arguments, **options):
            result = real(*arguments, **options)
            calls.append((name, describe(*arguments)))
            return result

        monkeypatch.setattr(os, name, call)

    def of(fd, *_):
        return os.readlink(f"/proc/self/fd/{fd}")

    noted("fsync", of)
    noted("pwrite", of)
    noted("replace", lambda old, new: (str(old), new.name))
    session = Session(config_of(tmp_path / "run"), Counters(), lambda *_: None, lambda *_: None)
    for measurement in recorded()[:60]:
        session.ingest([measurement])
    session.finish()
    folder = str(tmp_path / "run")
    assert ("fsync", str(tmp_path)) in calls
    renamed = [k for k, (name, _) in enumerate(calls) if name == "replace"]
    names = [calls[k][1][1] for k in renamed]
    begun, results = names[:2], names[2:]
    assert begun == ["run.json", "config.yaml"]
    assert (len(results), len(set(results)), results[0], results[-1]) == (12, 12, "map.mcap", "run.json")
    for k in renamed:
        assert calls[k - 1] == ("fsync", calls[k][1][0])
        assert calls[k + 1] == ("fsync", folder)
    for name in ("ingest.mcap", "run.mcap"):
        last = {call: k for k, call in enumerate(calls)}
        assert last["pwrite", f"{folder}/{name}"] < last["fsync", f"{folder}/{name}"] < renamed[len(begun)]
        first = calls.index(("pwrite", f"{folder}/{name}"))
        assert ("fsync", folder) in calls[:first][-2:]


@dataclass(frozen=True)
class Reference:
    """The same run, undisturbed."""

    records: list
    acknowledged: list  # by update: how many records were accepted before it, and how many keyframes there were
    saved: list  # by save: the bytes of each file of results
    trajectory: np.ndarray

    @classmethod
    def of(cls, folder):
        saves = (folder.with_name(f"{folder.name}_save_{k}") for k in itertools.count())
        in_a_child(lambda tell: drive(folder, lambda what: what == SAVED and shutil.copytree(folder, next(saves))))
        there = sorted(folder.parent.glob(f"{folder.name}_save_*"))
        saved = [{name: (save / name).read_bytes() for name in RESULTS} for save in there]
        records = list(read_ingest(folder, losses := []))
        assert not losses
        assert len({state["run.json"] for state in saved}) == 2
        acknowledged, slam = replayed(records, config_of(folder))
        return cls(records, acknowledged, saved, slam.view.trajectory())

    def faults(self, folder, told, deep):
        """What is wrong with a folder that such a run has left, having told so much; ``deep``: by a replay, too."""
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
            again = replayed(records, run_config(folder))[1].view.keyframes
            assert len(again) >= keyframes, f"{len(again)} keyframes of {keyframes}"
            known, restored = (some.stamps_ns[:keyframes] for some in (again, map_of(folder, []).keyframes))
            assert restored.tolist() == known.tolist(), "the newest map, with the rest of the journal, has other ones"
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
            acknowledged.append((len(accepted), len(slam.view.keyframes)))
    return acknowledged, slam


def judged(judge, *arguments):
    """What is wrong, in words; empty: nothing."""
    try:
        judge(*arguments)
    except (AssertionError, GraphSlamError, OSError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return ""


def in_a_child(work, killed_after_s=None):
    """Do it in a forked process, or so much of it; returns how that ended, and what it told, which outlives it."""
    reading, writing = os.pipe()
    tell = functools.partial(os.write, writing)  # before anything is made to fail
    if not (pid := os.fork()):
        code = 1
        try:
            work(tell)
            code = 0
        except BaseException as error:
            tell(WRONG + f"{type(error).__name__}: {error}".encode())
        finally:
            os._exit(code)
    os.close(writing)
    if killed_after_s is not None:
        time.sleep(killed_after_s)
        os.kill(pid, signal.SIGKILL)
    with open(reading, "rb") as pipe:
        told = pipe.read()
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    assert WRONG not in told, told.partition(WRONG)[2].decode()
    return status, told


CALLS = ("open", "write", "pwrite", "fsync", "replace", "ftruncate")
ALSO_CRASHES = ("unlink", "rename", "mkdir")
KINDS = (errno.ENOSPC, errno.EIO, errno.EROFS, errno.EDQUOT, errno.EACCES, "short")


class Faulty:
    """Counts the calls that reach the disk below a folder, and acts at one of them (0: none), and all from there on."""

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


def crashes(state, root):
    """A crash at one call that reaches the disk, a later one, ... until there are no more: (tried, wrong)."""
    reference = Reference.of(root / "reference")
    folder, wrong = root / "run", []
    if state == "earlier run there":
        in_a_child(lambda tell: drive(folder, tell))
    for tried, n in enumerate(itertools.count(1, EVERY)):
        if state == "empty folder":  # else there is what the one before has left
            empty(folder)

        def work(tell, n=n):
            with Faulty(root, n, crashing, CALLS + ALSO_CRASHES):
                drive(folder, tell)

        code, told = in_a_child(work)
        if fault := judged(reference.faults, folder, told, tried % 8 == 0):
            wrong.append(f"{state}, call {n}: {fault}")
        if code == 0:
            return tried, wrong


def empty(folder):
    for file in folder.glob("*"):
        file.unlink()


def errors(state, root, kinds_of):
    """One call after the other fails, as ``kinds_of`` says: (tried, wrong, how often recording went on)."""
    reference = Reference.of(root / "reference")
    folder, wrong, tried, recovered = root / "run", [], 0, 0
    if state == "earlier run there":
        drive(folder, lambda what: None)
    for k, n in enumerate(itertools.count(1, FAILS_EVERY)):
        fired = 0
        for kind, lasts in kinds_of(k):
            if state == "empty folder":
                empty(folder)
            trial = Trial(reference, folder)
            if fault := judged(trial.go, n, failing(kind, lasts), kind):
                wrong.append(f"{state}, call {n}, {kind}{', lasting' if lasts else ''}: {fault}")
            tried, fired, recovered = tried + 1, fired + trial.fired, recovered + trial.has_recovered
        if not fired:
            return tried, wrong, recovered


class Trial:
    """One run on a disk that fails for a while: all that it is asked for is tried again when the disk is well."""

    def __init__(self, reference, folder):
        self._reference, self._folder, self._told = reference, folder, []
        self.has_recovered, self.fired = False, 0

    def go(self, n, act, kind):
        files, fails = set(os.listdir("/proc/self/fd")), []
        with Faulty(self._folder, n, act) as self._faulty:
            make = functools.partial(
                Session, config_of(self._folder), Counters(), lambda *_: None, lambda *told: self._told.append(told)
            )
            session = self._again(make)
            for k, measurement in enumerate(recorded()[:STEPS]):
                fails.append(session.recording_fails)
                session.ingest([measurement])
                if self._faulty.fired and k % 8 == 7:
                    self._faulty.at = 0  # all is well
                if k + 1 == SAVE:
                    self._again(session.save)
            self._again(session.finish)
        fails.append(session.recording_fails)
        self.fired, self.has_recovered = self._faulty.fired, any(fails) and not fails[-1]
        assert not fails[-1], "it still says that recording fails"
        assert self._told or kind == "short" or not self.fired, "nobody was told"
        self._compare(session)
        assert set(os.listdir("/proc/self/fd")) <= files, "files were left open"

    def _again(self, call):
        """When it fails, once more on a disk that is well."""
        try:
            return call()
        except RunError as error:
            self._told.append(error)
            assert not list(self._folder.glob(f"*{NEW}")), "a new file was left there"
            assert self._faulty.fired, error
            self._faulty.at = 0
            return call()

    def _compare(self, session):
        losses, reference = [], self._reference
        records = list(read_ingest(self._folder, losses))
        assert not losses, losses
        assert measured(records) == measured(reference.records), "the journal is not complete"
        _, again = replayed(records, run_config(self._folder))
        assert np.array_equal(again.view.trajectory(), session.slam.view.trajectory()), "the journal gives another path"
        assert np.allclose(session.slam.view.trajectory(), reference.trajectory, rtol=0.0, atol=1e-6), "another path"
        assert not list(self._folder.glob(f"*{NEW}")), "a new file was left there"
        assert json.loads((self._folder / "run.json").read_text())["keyframes"] == len(session.slam.view.keyframes)


def measured(records):
    """Without what each further save asks the pipeline for."""
    return [record for record in records if record["type"] != "control"]


def test_T11_P1_P2_a_crash_at_any_call_that_reaches_the_disk_loses_nothing_that_was_told(memory):
    """In children of this process. A kill between two calls leaves what a crash at the second does."""
    drive(memory / "warm", lambda what: None)  # what is slow the first time
    for state in STATES if IS_LONG else STATES[:1]:
        (memory / state).mkdir()
        tried, wrong = crashes(state, memory / state)
        tell("crash_at_nth_call", tried=tried, faults=tried, failed=len(wrong))
        assert not wrong


def test_T10_P1_P2_killed_at_any_moment_it_loses_nothing_that_was_told(memory):
    reference, folder, wrong, began_s = Reference.of(memory / "reference"), memory / "run", [], time.perf_counter()
    in_a_child(lambda tell: drive(folder, tell))
    moments = np.random.default_rng(0).uniform(0.0, time.perf_counter() - began_s, KILLS)
    for k, killed_after_s in enumerate(moments):
        empty(folder)
        _, told = in_a_child(lambda tell: drive(folder, tell), killed_after_s)
        if fault := judged(reference.faults, folder, told, k % 8 == 0):
            wrong.append(f"{len(told)} told: {fault}")
    tell("kill_9", tried=KILLS, faults=KILLS, failed=len(wrong))
    assert not wrong


def test_T12_P4_a_disk_that_fails_at_any_call_is_told_of_and_loses_nothing(memory):
    some, every = (
        [(kind, lasts) for lasts in (True, False) for kind in KINDS],
        [*itertools.product(KINDS, (False, True))],
    )
    recovered = 0
    for state in STATES if IS_LONG else STATES[1:]:
        (memory / state).mkdir()
        tried, wrong, went_on = errors(state, memory / state, lambda k: every if IS_LONG else [some[k % len(some)]])
        tell("io_error_at_nth_call", tried=tried, faults=tried, failed=len(wrong))
        assert not wrong
        recovered += went_on
    assert recovered > (tried / 20 if IS_LONG else 0)  # recording was seen to fail, and to go on

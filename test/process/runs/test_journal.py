"""The journal: what was told outlives whatever ends the process, and a disk that fails loses nothing."""

import errno
import itertools
import json
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import threading
from dataclasses import dataclass

import journal_torture
import pytest
from journal_torture import IS_LONG, KINDS, STATES, config_of, errors, recorded, row
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from reliability import times

from graph_slam_ros.errors import FormatError
from graph_slam_ros.measurements.types import to_record
from graph_slam_ros.node.session import Session
from graph_slam_ros.recordings.mcap_records import MAGIC
from graph_slam_ros.runs.folder import BEGUN, RunError
from graph_slam_ros.runs.journal import RecordWriter, part_name, read_ingest
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config, Counters, GraphSlam, Odometry

CUTS, FLIPS, KILLS = times((100, 60, 5), (None, 5_000, 3_000))  # None: at every byte


# -- cut and flipped ---------------------------------------------------------------------------------------------------


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
    """A journal of 200 KB as the live session writes it, flushed at each update, in eight files."""
    folder, accepted, flushes, written = tmp_path_factory.mktemp("journal") / "run", [], [], []
    config = Config.from_mapping({"keyframes.min_distance_m": 0.02, "keyframes.min_angle_rad": 0.02})
    recorder = RunRecorder(folder, config, 1.0)

    def size():
        file = file_of(folder, len(written))
        return file.stat().st_size if file.exists() else 0

    def note():
        if size() > flushes[-1][-1][0] and len(accepted) > flushes[-1][-1][1]:  # else it is the index
            flushes[-1].append((size(), len(accepted)))

    def sink(measurement):
        accepted.append(as_read([measurement])[0])
        recorder.sink(measurement)  # it flushes, too, where the disk is to take it
        note()

    slam = GraphSlam(config, sink)
    flushes.append([(size(), 0)])
    for k, measurement in enumerate(recorded()[:1000]):
        if slam.process(measurement):
            recorder.flush()
            note()
        if k % 125 == 124:
            recorder._end_parts()
            note()
            written.append(list(accepted))
            accepted.clear()
            flushes.append([(0, 0)])
    out = []
    for number, records in enumerate(written):
        data = file_of(folder, number).read_bytes()
        ends = chunk_ends(data)
        assert all(
            a < end <= b for end, ((a, _), (b, _)) in zip(ends, itertools.pairwise(flushes[number]), strict=True)
        )
        out.append(
            Part(data, records, [(end, count) for end, (_, count) in zip(ends, flushes[number][1:], strict=True)])
        )
    assert 150_000 < sum(len(part.data) for part in out) < 400_000
    assert sum(len(part.flushed) for part in out) > 300
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
    assert not row("journal_cut", len(places), len(places), wrong)


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
    assert not row("journal_flipped", FLIPS, FLIPS, wrong)


def test_F19_a_length_of_2_to_the_60_in_a_journal_is_refused_before_memory_is_asked_for(parts, tmp_path):
    for end, count in parts[0].flushed[:-1]:
        data = bytearray(parts[0].data)
        struct.pack_into("<Q", data, end + 1, 2**60)
        losses = []
        read = list(read_ingest(laid_out(tmp_path, [data]), losses))
        assert read == parts[0].records[: len(read)]
        assert len(read) >= count
        assert losses


def test_F18_a_kind_of_record_that_is_not_known_is_refused_by_its_name(tmp_path):
    RunRecorder(tmp_path / "run", Config()).close()
    journal = tmp_path / "run" / "ingest.mcap"
    journal.unlink()
    writer = RecordWriter(journal)
    writer.write([to_record(Odometry(1, (0.0, 0.0, 0.0))), {"type": "sonar", "stamp_ns": 2}])
    writer.close()
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


# -- killed ------------------------------------------------------------------------------------------------------------


def tortured(*words):
    """By a process of its own, which forks: this one may have threads."""
    done = subprocess.run([sys.executable, journal_torture.__file__, *map(str, words)], capture_output=True, text=True)
    print(done.stdout, done.stderr)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_T10_P1_P2_killed_at_any_moment_it_loses_nothing_that_was_told(memory):
    said = tortured("kills", KILLS, memory)
    assert f"RELIABILITY kill_9 tried={KILLS} faults={KILLS} failed=0" in said


def test_T11_a_crash_at_any_call_that_reaches_the_disk_loses_nothing_that_was_told(memory):
    said = tortured("crashes", len(STATES) if IS_LONG else 1, memory)
    assert "RELIABILITY crash_at_nth_call" in said


# -- a disk that fails -------------------------------------------------------------------------------------------------


def test_T12_P4_a_disk_that_fails_at_any_call_is_told_of_and_loses_nothing(memory):
    def one_of(k):
        return [(KINDS[k % len(KINDS)], k // len(KINDS) % 2 == 0)]

    def each(k):
        return itertools.product(KINDS, (False, True))

    tried, wrong, recovered = 0, [], 0
    for state in STATES if IS_LONG else STATES[1:2]:
        (memory / state).mkdir()
        trials, some, went_on = errors(state, memory / state, each if IS_LONG else one_of)
        tried, wrong, recovered = tried + trials, wrong + some, recovered + went_on
    assert recovered > tried / 20  # recording was seen to fail, and to go on
    assert not row("io_error_at_nth_call", tried, tried, wrong)


def session_in(folder, told):
    return Session(config_of(folder), Counters(), lambda *_: None, lambda *some: told.append(some))


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="no limit of file sizes")
def test_P4_no_room_for_the_journal_is_told_and_all_is_written_when_there_is_room_again(tmp_path):
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    told, fails = [], []
    session = session_in(tmp_path / "run", told)
    journal = tmp_path / "run" / "ingest.mcap"
    try:
        for k, measurement in enumerate(recorded()[:120]):
            if k == 30:
                full = journal.stat().st_size + 100
                resource.setrlimit(resource.RLIMIT_FSIZE, (full, before[1]))
            if k == 60:
                assert journal.stat().st_size == full  # as much as there was room for
                with pytest.raises(RunError, match=os.strerror(errno.EFBIG)):
                    session.save()
                there = {file.name for file in (tmp_path / "run").iterdir()}
                assert there == {"run.json", "config.yaml", "ingest.mcap", "map.mcap", "run.mcap"}
                assert (tmp_path / "run" / "run.json").read_bytes() == BEGUN  # no result was saved
            if k == 90:
                resource.setrlimit(resource.RLIMIT_FSIZE, before)
            session.ingest([measurement])
            fails.append(session.recording_fails)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert [is_so for is_so, _ in itertools.groupby(fails)] == [False, True, False]
    assert ("output.folder", os.strerror(errno.EFBIG)) in told
    session.finish()
    losses = []
    records = list(read_ingest(tmp_path / "run", losses))
    assert not losses
    assert [r for r in records if r["type"] != "control"] == as_read(recorded()[:120])
    again = replay(tmp_path / "run", tmp_path / "again")
    assert again.slam.trajectory().tolist() == session.slam.trajectory().tolist()


def in_time(work):
    """Whether something ends in another thread."""
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(10.0)
    return not thread.is_alive()


@pytest.mark.parametrize("end", ["save", "leave", "close"])
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

    assert in_time(ends)
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
    session = session_in(tmp_path / "run", [])
    for measurement in recorded()[:60]:
        session.ingest([measurement])
    session.finish()
    folder = str(tmp_path / "run")
    assert ("fsync", str(tmp_path)) in calls
    renamed = [k for k, (name, _) in enumerate(calls) if name == "replace"]
    names = [calls[k][1][1] for k in renamed]
    begun, results = names[:2], names[2:]
    assert begun == ["run.json", "config.yaml"]
    assert (len(results), len(set(results)), results[-1]) == (11, 11, "run.json")
    for k in renamed:
        assert calls[k - 1] == ("fsync", calls[k][1][0])
        assert calls[k + 1] == ("fsync", folder)
    for name in ("ingest.mcap", "run.mcap"):
        last = {call: k for k, call in enumerate(calls)}
        assert last["pwrite", f"{folder}/{name}"] < last["fsync", f"{folder}/{name}"] < renamed[len(begun)]
        first = calls.index(("pwrite", f"{folder}/{name}"))
        assert ("fsync", folder) in calls[:first][-2:]

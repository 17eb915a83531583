"""Mutated files through the readers: each gives data or one of our errors, in 5 s of CPU time and 512 MiB.

``python test/fuzzing.py COUNT SEED FORMAT ...`` ends with 1 where a file did something else: it is kept under
``GRAPH_SLAM_FAULTS``. Half of the mutations of mcap files are made before chunks are compressed and summed up.
"""

import os
import random
import re
import resource
import signal
import sys
import tempfile
import warnings
import zlib
from pathlib import Path

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType
from recordings import TOPICS, short_drive, to_ros1, to_sqlite, write_mcap

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.replay import RecordedRuns
from graph_slam_ros.slam import Config

ROOT = Path(__file__).resolve().parents[1]
LIMIT_S, LIMIT_MIB = 5.0, 512
MESSAGES = 60  # of a seed: small files are read often
NUMBERS = (0, 1, 127, 128, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**60, 2**63, 2**64 - 1)
WORDS = (
    b"nan inf -inf 1e999 1e-320 -0 0x10 1_000 0123 12:30:45 yes ~ null . .inf 9999999999999999999999 "
    b"!!int !!python/object:x &a *a <<: | > --- ... '' \" [ ] { } ? : - , # % @ ` \\ "
    b"\t \0 \xff \xc3\x28 \xe2\x80\xa8 \xd9\xa1 FIX EDGE_SE2 EDGE3 "
    b"VERTEX_SE2 VERTEX_XY VERTEX3 LANDMARK ODOMETRY PARAMS_SE3OFFSET EDGE_SE3:QUAT"
).split(b" ")


def mutated(data, others, rng):
    """With one to four changes."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        if not data:
            break
        at, size = rng.randrange(len(data)), min(rng.choice((1, 4, 16, 64, 1024, 8192)), len(data))
        width = rng.choice((1, 2, 4, 8))
        match rng.randrange(9):
            case 0 | 1:
                data[at] ^= 1 << rng.randrange(8)
            case 2:
                number = rng.choice(NUMBERS) % 256**width
                data[at : at + width] = number.to_bytes(width, rng.choice(("little", "big")))
            case 3:
                del data[at : at + size]
            case 4:
                data[at:at] = data[at : at + size]
            case 5:
                data[at : at + size] = rng.randbytes(size)
            case 6:
                del data[at:]
            case 7:
                data[at : at + rng.choice((0, 1, 4))] = rng.choice(WORDS)
            case 8:
                other = rng.choice(others)
                data[at:] = other[rng.randrange(len(other)) :]
    return bytes(data)


def mutated_words(data, others, rng):
    """A text: words are exchanged, left out or doubled, besides."""
    parts = re.split(rb"(\s+)", data)
    for _ in range(rng.randint(0, 3)):
        at = rng.randrange(len(parts))
        parts[at] = rng.choice((rng.choice(WORDS), b"", parts[at] * 2, rng.choice(parts)))
    data = b"".join(parts)
    return mutated(data, others, rng) if rng.random() < 0.5 else data


def mutated_chunks(data, others, rng):
    """An mcap file whose chunks are whole, and hold what is not; or one that is changed anywhere."""
    if rng.random() < 0.5:
        return mutated(data, others, rng)
    out = RecordBuilder()
    out.write(data[:8])
    with tempfile.TemporaryFile() as stream:
        stream.write(data)
        stream.seek(0)
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk) and rng.random() < 0.5:
                plain = UNPACK[record.compression](record.data)
                plain = mutated(plain, [plain], rng)
                record.data, record.uncompressed_size = PACK[record.compression](plain), len(plain)
                record.uncompressed_crc = zlib.crc32(plain)
            record.write(out)
    out.write(data[:8])
    return out.end()


PACK = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}
UNPACK = {"zstd": zstandard.decompress, "lz4": lz4.frame.decompress, "": bytes}


def use_bag(path):
    """Every message through the border."""
    bag, config = open_bag(path), Config()
    for _ in RecordedRuns(bag, choose_inputs(bag, config), config):
        pass
    said = bag.losses + bag.warnings
    assert all(line.isprintable() for line in said), said
    return bool(bag.losses)


def use_graph(path):
    return bool(read_g2o(path, lenient=path.stat().st_size % 2 == 0).skipped)


def use_parameters(path):
    Config.from_mapping(read_parameters(path))
    return False


def drive(folder):
    bag = open_bag(short_drive(folder / "whole.mcap"))
    return list(bag.messages(TOPICS))[:MESSAGES]


def mcap(compression):
    def seeds(folder):
        return [
            write_mcap(folder / "a.mcap", drive(folder), compression=compression, chunk_size=size).read_bytes()
            for size in (4_000, 20_000)
        ]

    return seeds


def sqlite(folder):
    (file,) = to_sqlite(folder / "bag", drive(folder)).glob("*.db3")
    return [file.read_bytes()]


def ros1(folder):
    from rosbags.rosbag1 import Writer

    codecs = (None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4)
    messages = drive(folder)
    return [to_ros1(folder / f"{k}.bag", messages, codec, 4_000).read_bytes() for k, codec in enumerate(codecs)]


def graphs(folder):
    from graph_texts import PLANE, SPACE, in_dialect

    twins = ((PLANE, "toro"), (PLANE, "gtsam"), (SPACE, "toro"))
    return [text.encode() for text in (PLANE, SPACE, *(in_dialect(*twin)[1] for twin in twins))]


def parameter_files(folder):
    nav2, ours = ((ROOT / "config" / f"{name}.yaml").read_bytes() for name in ("nav2", "planar"))
    sections = re.split(rb"(?m)^(?=    \w+:\n)", ours)
    return [nav2, *(sections[0] + section for section in sections[1:])]


FORMATS = {
    "mcap_none": (mcap(CompressionType.NONE), mutated_chunks, use_bag, "a.mcap"),
    "mcap_zstd": (mcap(CompressionType.ZSTD), mutated_chunks, use_bag, "a.mcap"),
    "mcap_lz4": (mcap(CompressionType.LZ4), mutated_chunks, use_bag, "a.mcap"),
    "db3": (sqlite, mutated, use_bag, "a.db3"),
    "ros1": (ros1, mutated, use_bag, "a.bag"),
    "g2o": (graphs, mutated_words, use_graph, "a.g2o"),
    "yaml": (parameter_files, mutated_words, use_parameters, "a.yaml"),
}


class TooLongError(BaseException):
    """Of no family that a reader could catch."""


def too_long(signum, frame):
    raise TooLongError


def fuzz(name, count, seed):
    """How many of so many mutated files were refused or read with a loss, and what went wrong with others."""
    seeds, mutate, use, file_name = FORMATS[name]
    rng, faults, failures = random.Random(seed), 0, []
    signal.signal(signal.SIGPROF, too_long)
    warnings.simplefilter("error")  # nothing else is to be said
    with tempfile.TemporaryDirectory() as folder:
        whole = seeds(Path(folder))
        path = Path(folder) / file_name
        for data in whole:
            path.write_bytes(data)
            assert not use(path), "a seed is whole"
        confine()
        for k in range(count):
            data = mutate(rng.choice(whole), whole, rng)
            path.write_bytes(data)
            signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
            try:
                faults += use(path)
            except GraphSlamError as error:
                faults += 1
                if len(str(error).splitlines()) != 1:
                    failures.append(f"{k}: {error!r}")
            except BaseException as error:
                failures.append(f"{k}: {error!r}"[:300])
                keep(data, f"{name}-{seed}-{k}-{file_name}")
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
    return faults, failures


def confine():
    """What is mapped and not used counts, too: that of now is added to the limit."""
    with open("/proc/self/statm") as file:
        mapped, resident = (int(pages) * resource.getpagesize() for pages in file.read().split()[:2])
    limit = mapped - resident + LIMIT_MIB * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def keep(data, name):
    if folder := os.environ.get("GRAPH_SLAM_FAULTS"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        (Path(folder) / name).write_bytes(data)


def peak_mib():
    """Of this process alone: what getrusage tells begins with what its parent had."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def one(name, count, seed):
    """Of one format, in this process: prints what came of it; whether something failed."""
    faults, failures = fuzz(name, count, seed)
    mib = peak_mib()
    if mib > LIMIT_MIB:
        failures.append(f"{mib:.0f} MiB")
    print(f"RELIABILITY fuzz_{name} tried={count} faults={faults} failed={len(failures)}", flush=True)
    print(
        f"{mib:.0f} MiB, {sum(os.times()[:2]):.1f} s of CPU time", *failures[:10], sep="\n", file=sys.stderr, flush=True
    )
    return bool(failures)


def main(count, seed, *names):
    """Each format in a child of its own, which has little memory."""
    codes = []
    for name in names:
        if not (child := os.fork()):
            os._exit(one(name, int(count), int(seed)))
        codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    return any(codes)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

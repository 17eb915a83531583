"""Files that are made to exhaust their reader, or to write to the terminal of whoever looks at them."""

import gzip
import os
import sqlite3
import struct
from contextlib import closing, suppress

import pytest
from confined import confined
from rows import each

from graph_slam_ros.cli import console, main
from graph_slam_ros.errors import ConfigError, FormatError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.lie import jit
from graph_slam_ros.recordings import mcap_records
from graph_slam_ros.recordings.bag import BagError, open_bag

# A word, or lines, of n characters that a careless pattern matches in n^2 steps.
SHAPES = {
    "digits": lambda n: "1" * n + "x",
    "decimals": lambda n: "." + "1" * n + "x",
    "points": lambda n: "1." * (n // 2),
    "exponent": lambda n: "1e" + "1" * n + "x",
    "underscores": lambda n: "1_" * (n // 2),
    "sixties": lambda n: "1:" * (n // 2) + "x",
    "spaces": lambda n: " " * n + "x",
    "comment": lambda n: "# 1 1" + " " * n + "x",
    "lines": lambda n: "\n" * n + "x",
    "quotes": lambda n: "'" * n,
    "brackets": lambda n: "[" * n,
    "keys": lambda n: "a: " * (n // 3),
}
WRITERS = {
    "g2o": ("graph.g2o", lambda text: f"VERTEX_SE2 0 0 0 {text}\n", read_g2o, FormatError),
    "yaml": ("config.yaml", lambda text: f"a: {text}\n", read_parameters, ConfigError),
    "mcap": ("a.mcap", lambda text: f"\x89MCAP0\r\n{text}", open_bag, BagError),
    "bag": ("a.bag", lambda text: f"#ROSBAG V2.0\n{text}", open_bag, BagError),
}


@each("kind", WRITERS)
def test_F33_what_a_careless_pattern_would_match_for_hours_is_read_or_refused(tmp_path, kind):
    name, text, read, refusal = WRITERS[kind]
    for shape in SHAPES.values():
        (tmp_path / name).write_text(text(shape(100_000)), encoding="latin-1")
        with suppress(refusal):
            read(tmp_path / name)


def test_F33_a_line_and_a_number_have_a_longest(tmp_path):
    (tmp_path / "line.g2o").write_text("# " + "x" * 2**20)
    with pytest.raises(FormatError, match=r"line.g2o:1: a line of more than 1048576 characters"):
        read_g2o(tmp_path / "line.g2o")
    (tmp_path / "number.g2o").write_text(f"VERTEX_SE2 0 0 0 {'0' * 2000}\n")
    with pytest.raises(FormatError, match="is not a finite number"):
        read_g2o(tmp_path / "number.g2o")


def test_F34_a_table_that_computes_its_messages_is_refused_before_any_is(tmp_path):
    path = tmp_path / "bomb.db3"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        database.execute("INSERT INTO topics VALUES (1, '/odom', 'nav_msgs/msg/Odometry', 'cdr')")
        computed = "data BLOB GENERATED ALWAYS AS (zeroblob(200000000)) VIRTUAL"
        database.execute(
            f"CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, {computed})"
        )
        rows = [(k, k) for k in range(99)]
        database.executemany("INSERT INTO messages(id, topic_id, timestamp) VALUES (?, 1, ?)", rows)
    assert path.stat().st_size < 20_000
    with pytest.raises(BagError, match="the column data of messages is computed"):
        open_bag(path)


@each("text", ["VERTEX_SE2 0 0 0 0\n", "1"])
def test_F35_a_gzipped_graph_that_grows_without_end_is_not_unpacked(tmp_path, text):
    path = tmp_path / "bomb.g2o.gz"
    with gzip.open(path, "wb") as stream:
        for _ in range(30):
            stream.write(text.encode() * (2_000_000 // len(text)))
    with pytest.raises(FormatError, match=r"unpacks to more than 100 times its size|a line of more than"):
        confined(read_g2o, path)


@each("name, begin", [("a.g2o", b""), ("a.mcap", mcap_records.MAGIC + b"\xff" * 99), ("a.bag", b"#ROSBAG V2.0\n")])
def test_F35_a_sparse_file_of_a_terabyte_is_refused_at_once(tmp_path, capsys, name, begin):
    path = tmp_path / name
    path.write_bytes(begin)
    os.truncate(path, 2**40)
    assert main(["optimize" if name == "a.g2o" else "info", str(path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@each("claims", [lambda left: left - 9, lambda left: 44])
def test_F35_forged_heads_of_chunks_one_after_another_cost_little_each(tmp_path, claims):
    heads, body = 8_000, b""
    for k in range(heads):
        length = claims(58 * (heads - k))
        head = struct.pack("<Q", length) + bytes(28) + b"\4\0\0\0zstd" + struct.pack("<Q", length - 44)
        body += b"\x06" + head + b"\xff"
    path = tmp_path / "forged.mcap"
    path.write_bytes(mcap_records.MAGIC + body + mcap_records.MAGIC)
    with suppress(BagError):
        open_bag(path)


def test_F36_a_byte_order_mark_is_no_part_of_the_first_word(tmp_path):
    (tmp_path / "graph.g2o").write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n", encoding="utf-8-sig")
    assert read_g2o(tmp_path / "graph.g2o").graph.vertex_count == 2
    (tmp_path / "config.yaml").write_text("solve:\n  every_keyframes: 2\n", encoding="utf-8-sig")
    assert read_parameters(tmp_path / "config.yaml") == {"solve": {"every_keyframes": 2}}


HOSTILE = "tag\x1b]0;owned\x07\x1b[2J\nkeyframes 7\u202ered\u200b"


def test_X11_what_a_name_says_to_a_terminal_is_shown_and_not_done_and_a_line_is_one_line(tmp_path, capsys):
    lines = [f"VERTEX_SE2 {k} {k} 0 0\n" for k in range(3)]
    one = "EDGE_SE2 {} {} 1 0 0 100 0 0 100 0 400\n"
    weird = "# 0 2 class " + HOSTILE.replace("\n", "").replace(" ", "") + "\n"
    (tmp_path / "graph.g2o").write_text("".join([*lines, weird, one.format(0, 1), one.format(1, 2)]))
    assert main(["optimize", str(tmp_path / "graph.g2o")]) in (0, 3)
    said = capsys.readouterr()
    assert "owned" in said.out
    assert not set(said.out + said.err) & set("\x1b\x07\u202e\u200b")
    console.show(f"landmark {HOSTILE}")
    console.warn(HOSTILE)
    console.report_losses([HOSTILE], [HOSTILE])
    console.report_losses([f"{k}" for k in range(100)])
    said = capsys.readouterr()
    assert len(said.out.splitlines()) == 1
    assert len(said.err.splitlines()) == 3 + 21
    assert not set(said.out + said.err) & set("\x1b\x07\u202e\u200b")


def test_X12_compiled_kernels_are_loaded_from_a_folder_of_ours_that_nobody_else_can_write_to(tmp_path, monkeypatch):
    monkeypatch.setenv("GRAPH_SLAM_CACHE", str(tmp_path))
    first = jit._cache_dir()
    assert first.is_relative_to(tmp_path)
    first.chmod(0o777)
    assert jit._cache_dir() == first
    assert first.stat().st_mode & 0o777 == 0o700
    if os.getuid() == 0:  # who alone can give a file to somebody else
        (first / "planted.nbi").touch()
        os.chown(first / "planted.nbi", 12345, 12345)
        assert jit._cache_dir() != first
        (first / "planted.nbi").unlink()
    first.rename(tmp_path / "elsewhere")
    first.symlink_to(tmp_path / "elsewhere")
    assert not jit._cache_dir().is_relative_to(tmp_path)

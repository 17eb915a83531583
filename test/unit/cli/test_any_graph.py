"""Whatever is in a graph file: it is solved or refused in one line, and nothing else is said."""

import json
import random

import pytest
from graph_texts import PLANE, SPACE, in_dialect
from rows import each

from graph_slam_ros.cli import main
from graph_slam_ros.runs.folder import MARK

MORE = """\
VERTEX_SE2 12 2.5 0 0.3
FIX 10
EDGE_SE2 11 12 1 0 0 10 0 0 10 0 10
EDGE_SE2 10 12 2 0 0 10 0 0 10 0 10
EDGE_SE2_XY 12 7 0.5 4 10 0 10
"""
NUMBERS = ("nan", "inf", "1e400", "1e308", "-1e308", "1e-320", "x", "-1", "0", "-0", "3.7", "0x10", "1_000", "\u0661")
WORDS = (*NUMBERS, "9" * 30, str(2**31), str(2**63), "\0", "#", "FIX", "EDGE_SE2", "VERTEX_XY")


def damaged(text, rng):
    """With words exchanged, left out or added, and lines left out, doubled or cut."""
    lines = text.splitlines()
    for _ in range(rng.randint(1, 3)):
        k = rng.randrange(len(lines))
        words, how = lines[k].split(" "), rng.randrange(8)
        at = rng.randrange(len(words))
        if how < 4:
            words[at] = rng.choice(WORDS)
        elif how == 4:
            del words[at]
        elif how == 5:
            words.append(rng.choice(WORDS))
        elif how == 6:
            lines.insert(k, rng.choice(lines))
        lines[k] = " ".join(words)[: rng.randrange(200) if how == 7 else None]
    return "\n".join(lines)


def command(file, folder, rng):
    start, method = rng.choice(["file", "tree", "chordal", "online"]), rng.choice(["gn", "lm", "dogleg"])
    lenient = ["--lenient"] * rng.randrange(2)
    out = ("--out", folder / f"out.{rng.choice(['g2o', 'tum'])}", "--force")
    return "optimize", file, "--init", start, "--method", method, "--max-iterations", "20", *lenient, *out


@pytest.mark.filterwarnings("error")
@each("name, dialect", [("plane", "g2o"), ("plane", "toro"), ("plane", "gtsam"), ("space", "g2o"), ("space", "toro")])
def test_whatever_is_in_a_file_it_is_used_or_refused_in_one_line(tmp_path, capsys, name, dialect):
    text, file = {"plane": PLANE + MORE, "space": SPACE}[name], tmp_path / f"file.{dialect}"
    text = text if dialect == "g2o" else in_dialect(text, dialect)[1]
    for seed in range(15):
        rng = random.Random(seed)
        file.write_text(damaged(text, rng))
        capsys.readouterr()
        code = main([str(word) for word in command(file, tmp_path, rng)])
        said = capsys.readouterr().err.splitlines()
        assert code in (0, 2, 3), said
        assert all(line.startswith("graph_slam: ") for line in said)
        assert code != 2 or len(said) == 1


def test_of_a_run_folder_the_graph_is_named(tmp_path, capsys):
    (tmp_path / "run.json").write_text(json.dumps({"format": MARK}))
    assert main(["optimize", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"graph_slam: {tmp_path}: a run folder; its graph is {tmp_path / 'graph.g2o'}\n"

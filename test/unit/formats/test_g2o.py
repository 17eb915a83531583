"""g2o files: what is written is read back, and what is wrong is named with its line."""

import gzip
import re
from dataclasses import replace

import numpy as np
import pytest
from rows import each

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.graph import (
    LANDMARK_POSITION,
    POSE_PRIOR,
    R1,
    R2,
    RELATIVE_POSE,
    SE2,
    TAG_POSITION,
    Gaussian,
    Graph,
)

FINE = """\
# two poses and a landmark
VERTEX_SE2 10 0 0 0
VERTEX_SE2 11 1.5 -2e-3 .25
VERTEX_XY 7 3. +4
EDGE_SE2 10 11 1 0 0.1 10 1 -2 20 3 30
"""


@pytest.fixture
def read(tmp_path):
    def read(text, **options):
        path = tmp_path / "graph.g2o"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_g2o(path, **options)

    return read


def values_of(graph):
    return lambda ids: graph.initial.values[graph.begins(ids)[:, None] + np.arange(graph.kind_of(ids[0]).size)]


def test_a_file_becomes_vertices_and_edges_in_its_own_words(read):
    more = "FIX 11\nEDGE_SE2_XY 11 7 1 2 4 1 9\n# 3 1 class b\nEDGE_SE2 11 10 0 0 0 1 0 0 1 0 1\n"
    file = read((FINE + more).replace("\n", "\r\n\r\n"))  # as Windows ends lines, and with blank ones
    graph = file.graph
    assert (file.ids, file.fixed) == ([10, 11, 7], [1])
    assert [graph.kind_of(v) for v in range(3)] == [SE2, SE2, R2]
    assert graph.initial.values.tolist() == [0, 0, 0, 1.5, -2e-3, 0.25, 3, 4]
    assert "landmarks" in graph.labels
    table = graph.tables[RELATIVE_POSE]
    assert graph.labels[table.label.values[1]] == "b", "as a comment of ours says"
    assert table.vertices.tolist() == [[0, 1], [1, 0]]
    # the upper triangle, row by row
    information = Gaussian(table.sqrt_information.values[0]).information
    assert information == pytest.approx(np.array([[10, 1, -2], [1, 20, 3], [-2, 3, 30.0]]), rel=1e-13)
    sighting = graph.tables[LANDMARK_POSITION]
    assert (sighting.vertices.tolist(), sighting.measured.values.tolist()) == ([[1, 2]], [[1, 2]])


def random_graph():
    rng, graph = np.random.default_rng(8), Graph()
    graph.add_vertices(SE2, rng.standard_normal((5, 3)) * [1e6, 1e-6, 1.0])
    graph.add_vertices(R2, rng.standard_normal((2, 2)) / 3)
    graph.add_vertex(SE2, [0.1, 1 / 3, -np.pi])

    def noise(count, size):
        a = rng.standard_normal((count, size, size)) * 10.0 ** rng.uniform(-4, 4, (count, size, 1))
        return Gaussian.from_information(a @ np.swapaxes(a, 1, 2))

    graph.add_edges(RELATIVE_POSE, [[i, i + 1] for i in range(4)], rng.standard_normal((4, 3)), noise(4, 3), "odometry")
    graph.add_edges(RELATIVE_POSE, [[0, 4], [3, 1]], rng.standard_normal((2, 3)), noise(2, 3), "closures")
    graph.add_edges(LANDMARK_POSITION, [[0, 5], [3, 6]], rng.standard_normal((2, 2)), noise(2, 2), "landmarks")
    graph.add_edges(TAG_POSITION, [[2, 7]], rng.standard_normal((1, 2)), noise(1, 2), "landmarks")
    graph.add_edges(POSE_PRIOR, [[0]], rng.standard_normal((1, 3)), noise(1, 3), "priors")
    return graph


def test_what_is_written_is_read_back_to_the_bit(tmp_path, read):
    file = read(FINE)
    file.graph, file.ids, file.fixed = random_graph(), [100, 4, 8, 15, 16, 1, 2, 1000], [3, 5]
    file.unknown = ["PARAMS_SE2OFFSET 0   0 0 0", "VERTEX_TAG 5 it's \u00fcnknown"]
    write_g2o(tmp_path / "a.g2o", file, values_of(file.graph))
    again = read_g2o(tmp_path / "a.g2o")
    assert (again.ids, again.fixed, again.unknown) == (file.ids, file.fixed, file.unknown)
    assert again.graph.initial.values.tobytes() == file.graph.initial.values.tobytes()
    assert list(again.graph.tables) != [] and set(again.graph.tables) == set(file.graph.tables)
    for kind, table in file.graph.tables.items():
        other = again.graph.tables[kind]
        order, order_again = (np.lexsort(t.measured.values.T) for t in (table, other))
        assert np.array_equal(table.vertices[order], other.vertices[order_again])
        assert table.measured.values[order].tobytes() == other.measured.values[order_again].tobytes()
        one, two = (
            Gaussian(t.sqrt_information.values[o]).information for t, o in ((table, order), (other, order_again))
        )
        sigma = np.sqrt(np.diagonal(one, axis1=1, axis2=2))
        assert np.abs((one - two) / sigma[:, :, None] / sigma[:, None, :]).max() < 1e-12
    write_g2o(tmp_path / "b.g2o", again, values_of(again.graph))
    lines, lines_again = ((tmp_path / f"{n}.g2o").read_text().splitlines() for n in "ab")
    vertices = [line for line in lines if not line.startswith("EDGE")]
    assert vertices == [line for line in lines_again if not line.startswith("EDGE")]
    last = max(k for k, line in enumerate(lines) if line.startswith("EDGE"))
    odd = [line for line in lines[:last] if line not in file.unknown and not re.match(r"\S+ -?\d+ -?\d", line)]
    assert odd == [], "GTSAM looks for two integers in every line down to the last edge"


@each("ending", [".gz", ".GZ"])
def test_a_gzipped_file_is_read_as_the_text_in_it_and_written_again(tmp_path, read, ending):
    plain, path = read(FINE), tmp_path / f"graph.g2o{ending}"
    path.write_bytes(gzip.compress(FINE.replace("\n", "\r\n").encode()))
    file = read_g2o(path)
    assert (file.ids, file.graph.edge_count) == (plain.ids, 1)
    assert file.graph.initial.values.tobytes() == plain.graph.initial.values.tobytes()
    write_g2o(path, file, values_of(file.graph))
    write_g2o(tmp_path / "plain.g2o", file, values_of(file.graph))
    assert gzip.decompress(path.read_bytes()) == (tmp_path / "plain.g2o").read_bytes()
    first = path.read_bytes()
    write_g2o(path, file, values_of(file.graph))
    assert path.read_bytes() == first  # no time of day in it


WHOLE = gzip.compress(("# " + "x" * 50_000 + "\n" + FINE).encode(), mtime=0)


@each(
    "content",
    [FINE.encode(), WHOLE[:-20], WHOLE[:30], WHOLE[:5], WHOLE[:20] + b"\xff" * 8 + WHOLE[28:], WHOLE[:-8] + bytes(8)],
)
def test_F5_a_damaged_gzip_file_is_refused_by_name(tmp_path, content):
    path = tmp_path / "graph.g2o.gz"
    path.write_bytes(content)
    for lenient in (False, True):
        with pytest.raises(FormatError, match=r"^graph\.g2o\.gz: damaged, or not a gzip file$"):
            read_g2o(path, lenient=lenient)


def test_what_cannot_be_written_is_named(tmp_path, read):
    file = read(FINE)
    for path, why in ((tmp_path / "no" / "where.g2o", "No such file"), (tmp_path, "not a regular file")):
        with pytest.raises(FormatError, match=why):
            write_g2o(path, file, values_of(file.graph))
    file.graph.add_vertex(replace(R1, name="R1 of mine"), [0.0])
    file.ids.append(12)
    with pytest.raises(FormatError, match="no tag for a vertex R1 of mine"):
        write_g2o(tmp_path / "out.g2o", file, values_of(file.graph))
    assert not (tmp_path / "out.g2o").exists()


@each("upper", ["4 0 0 4 0 0", "4 2 2 1 1 1", "4 0 0 0 0 0"])
def test_a_prior_may_say_nothing_in_some_directions(tmp_path, upper):
    path = tmp_path / "prior.g2o"
    path.write_text(f"VERTEX_SE2 0 0 0 0\nEDGE_PRIOR_SE2 0 1 2 0 {upper}\n")
    file = read_g2o(path)
    (table,) = file.graph.tables.values()
    root, numbers = table.sqrt_information.values[0], [float(word) for word in upper.split()]
    assert (root.T @ root)[np.triu_indices(3)] == pytest.approx(numbers, abs=1e-12)
    assert not file.notes
    for none in ("0 0 0 0 0 0", "4 0 0 4 0 -1", "4 5 0 4 0 0"):
        path.write_text(f"VERTEX_SE2 0 0 0 0\nEDGE_PRIOR_SE2 0 1 2 0 {none}\n")
        with pytest.raises(FormatError, match="is not positive definite"):
            read_g2o(path)

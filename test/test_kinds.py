"""Kinds of tests: each has one by its file, and a unit test can start no process."""

import os
from pathlib import Path

import pytest
import soak
from conftest import is_soaked


@pytest.mark.parametrize(
    "start", [lambda: os.system("true"), lambda: os.posix_spawn("/bin/true", ["true"], {})], ids=["system", "spawn"]
)
def test_a_unit_test_that_starts_a_process_fails_and_says_what_is_missing(start):
    with pytest.raises(RuntimeError, match="starts a process, and nothing in it says so: STARTS_ONE in conftest"):
        start()


def test_each_test_is_of_one_kind(request):
    kinds = ("unit", "integration", "process")
    assert all(sum(map(item.keywords.__contains__, kinds)) == 1 for item in request.session.items)
    assert request.node.get_closest_marker("unit")


def test_each_file_of_which_more_is_tried_in_make_soak_is_in_a_programme_of_it():
    """What counts by hand or by ``GRAPH_SLAM_SOAK`` would be cut short for nothing."""
    words = {word for programme in soak.PROGRAMMES.values() for word in programme}
    files = [file for file in Path(__file__).parent.glob("test_*.py") if is_soaked(file)]
    assert len(files) > 10
    assert [file.name for file in files if f"test/{file.name}" not in words] == []

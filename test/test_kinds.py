"""Kinds of tests: each has one by its file, and a unit test can start no process."""

import os

import pytest


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

"""Kinds of tests: each has one by its folder, and a unit test can start no process."""

import os
from collections import Counter

import pytest
import soak
from conftest import KINDS, is_soaked
from places import ROOT
from rows import each


@each("start", [lambda: os.system("true"), lambda: os.posix_spawn("/bin/true", ["true"], {})])
def test_a_unit_test_that_starts_a_process_fails_and_says_what_is_missing(start):
    with pytest.raises(RuntimeError, match=r"test_kinds\.py starts a process: it belongs into test/process"):
        start()


def test_each_test_is_of_one_kind_and_no_two_files_have_one_name(request):
    """The folders are no packages: pytest imports a file by its name alone, and refuses the second of two."""
    assert all(sum(map(item.keywords.__contains__, KINDS)) == 1 for item in request.session.items)
    times = Counter(file.name for file in (ROOT / "test").rglob("*.py"))
    assert [name for name, n in times.items() if n > 1] == []


def test_each_file_of_which_more_is_tried_in_make_soak_is_in_a_programme_of_it():
    """What counts by hand or by ``GRAPH_SLAM_SOAK`` would be cut short for nothing."""
    words = {word for programme in soak.PROGRAMMES.values() for word in programme}
    files = [file for file in (ROOT / "test").rglob("test_*.py") if is_soaked(file)]
    assert len(files) > 10
    assert [file.name for file in files if str(file.relative_to(ROOT)) not in words] == []

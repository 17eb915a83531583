"""Mutated files through the readers of every format; ``make soak`` tries more."""

import subprocess
import sys

import fuzzing
from reliability import times

COUNT = times(25, 5000)


def test_T7_a_mutated_file_gives_data_or_an_error_of_ours_in_time_and_memory(capsys):
    command = [sys.executable, fuzzing.__file__, str(COUNT), "1", *fuzzing.FORMATS]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600 * len(fuzzing.FORMATS))
    with capsys.disabled():
        print(f"\n{done.stdout.strip()}", end="")
    assert done.returncode == 0, done.stderr
    found = [line.split(" faults=")[0] for line in done.stdout.splitlines()]
    assert found == [f"RELIABILITY fuzz_{name} tried={COUNT}" for name in fuzzing.FORMATS]

"""Mutated files through the readers of every format; ``make soak`` tries more."""

import random
import subprocess
import sys
from pathlib import Path

import fuzzing
import guided_fuzzing
import pytest
from mcap.writer import CompressionType
from reliability import times
from rosbags.highlevel import AnyReader

COUNT = times(25, 5000)


@pytest.mark.parametrize("name", fuzzing.FORMATS)
def test_T7_a_mutated_file_gives_data_or_an_error_of_ours_in_time_and_memory(name, capsys):
    command = [sys.executable, fuzzing.__file__, name, str(COUNT), "1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    with capsys.disabled():
        print(f"\n{done.stdout.strip()}", end="")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"RELIABILITY fuzz_{name} tried={COUNT} ")


def test_T7_the_mutations_are_such_that_a_reader_without_care_does_not_stand_them(tmp_path):
    seeds = fuzzing.mcap(CompressionType.NONE)(tmp_path)
    rng, path, raised = random.Random(1), Path(tmp_path) / "b.mcap", set()
    for _ in range(150):
        path.write_bytes(fuzzing.mutated_chunks(rng.choice(seeds), seeds, rng))
        try:
            with AnyReader([path]) as reader:
                for _ in reader.messages():
                    pass
        except Exception as error:
            raised.add(type(error))
    assert len(raised) > 3


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", guided_fuzzing.TARGETS)
def test_T8_the_corpus_of_the_guided_fuzzer_gives_data_or_errors_of_ours(tmp_path, name):
    run, inputs = guided_fuzzing.target(name, tmp_path / "input"), sorted((guided_fuzzing.CORPUS / name).iterdir())
    assert len(inputs) > 10
    for file in inputs:
        run(file.read_bytes())

"""Calls in a fresh process on one core: nobody profits from, or pays for, what another left behind."""

import math
import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Crashed(Exception):
    """The process ended without an answer."""


def call(function: Callable[..., Any], *arguments: Any, python: str = sys.executable, cpu_s: float = math.inf) -> Any:
    """``function(*arguments)`` in a fresh process of the given interpreter.

    Parameters
    ----------
    cpu_s : CPU time, after what loading takes, at which it is called off

    Raises
    ------
    Crashed
        With the last line of what the process wrote to its standard error; or it was called off.
    """
    with tempfile.TemporaryDirectory() as folder:
        asked, answered = Path(folder) / "asked", Path(folder) / "answered"
        asked.write_bytes(pickle.dumps((function, arguments)))
        done = subprocess.run(
            [python, "-m", "benchmarks.fresh", str(asked), str(answered), str(cpu_s)],
            cwd=ROOT,
            env=os.environ | _ONE_THREAD,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
        if done.returncode == -signal.SIGXCPU:
            raise Crashed(f"called off after {cpu_s:g} s")
        if not answered.exists():
            last = done.stderr.strip().splitlines()[-1:] or [f"exit status {done.returncode}"]
            raise Crashed(last[0])
        return pickle.loads(answered.read_bytes())


def children_s() -> float:
    """CPU time of all child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _answer(asked: Path, answered: Path, cpu_s: float) -> None:
    function, arguments = pickle.loads(asked.read_bytes())
    if math.isfinite(cpu_s):
        so_far = resource.getrusage(resource.RUSAGE_SELF)
        most = math.ceil(so_far.ru_utime + so_far.ru_stime + cpu_s)
        resource.setrlimit(resource.RLIMIT_CPU, (most, most + 5))
    answer = pickle.dumps(function(*arguments))
    answered.write_bytes(answer)


if __name__ == "__main__":
    _answer(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))

"""Answers of fresh processes, kept in a folder: a programme of hours that was stopped goes on where it was."""

import hashlib
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import contenders
from benchmarks.contenders import OURS
from benchmarks.fresh import ROOT


@dataclass(frozen=True, slots=True)
class Kept:
    """What was answered, a file for each question."""

    folder: Path

    def ask(self, key: str, call: Callable[[], Any]) -> Any:
        """The answer to a question that was asked before, or that of ``call``, which is kept."""
        file = self.folder / f"{key}.pickle"
        if file.exists():
            return pickle.loads(file.read_bytes())
        answer = call()
        self.folder.mkdir(parents=True, exist_ok=True)
        unfinished = file.with_suffix(".part")
        unfinished.write_bytes(pickle.dumps(answer))
        unfinished.replace(file)
        return answer


def digest(*parts: Any) -> str:
    """Of arrays by their numbers, of all else by what is printed of it."""
    out = hashlib.sha256()
    for part in parts:
        out.update(np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return out.hexdigest()


@cache
def code_of(who: str) -> str:
    """What a contender among false measurements runs: when that changes, it is asked anew."""
    module = ROOT / "benchmarks/contenders" / f"{contenders.robust_module(who)}.py"
    package = sorted((ROOT / "graph_slam_ros").rglob("*.py")) if who.startswith(OURS) else []
    return digest(*(path.read_bytes() for path in (module, *package)), "" if package else version("gtsam"))

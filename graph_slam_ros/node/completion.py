"""Completion of earlier runs that were stopped while measurements were in the queue, in a process of low priority."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_NICE = 10


class Completion:
    """Runs ``graph_slam recover`` on one run after the other.

    Parameters
    ----------
    runs : folders of incomplete runs
    log : the logger of the node
    """

    def __init__(self, runs: Sequence[Path], log: Any) -> None:
        self._runs, self._log = list(runs), log
        self._process: subprocess.Popen[str] | None = None
        self._run = Path()

    def tick(self) -> None:
        """Check whether a process has ended, and start the next."""
        if self._process is not None and self._process.poll() is not None:
            self._report(self._process)
            self._process = None
        if self._process is None and self._runs:
            self._begin(self._runs.pop(0))

    def stop(self) -> None:
        """Stop the process that runs. The next start of the node starts it again."""
        self._runs.clear()
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _begin(self, run: Path) -> None:
        self._run = run
        self._log.info(f"{run.name} was stopped while measurements waited: its results are being completed")
        command = [sys.executable, "-m", "graph_slam_ros.cli", "recover", str(run)]
        path = os.pathsep.join(filter(None, sys.path))
        options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        self._process = subprocess.Popen(
            command, env=os.environ | {"PYTHONPATH": path}, start_new_session=True, text=True, **options
        )
        os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICE)

    def _report(self, process: "subprocess.Popen[str]") -> None:
        _, errors = process.communicate()
        if process.returncode:
            why = errors.strip().splitlines()[-1:] or [f"exit code {process.returncode}"]
            self._log.error(f"{self._run.name}: its results could not be completed: {why[0]}")
        else:
            self._log.info(f"{self._run.name}: its results are complete")

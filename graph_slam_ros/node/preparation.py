"""Loads the kernels, or compiles them at the first start, while the node answers."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from graph_slam_ros.errors import GraphSlamError, message_of
from graph_slam_ros.warmup import Compiling, are_compiled, warmup


class Preparation:
    """The work that must be done before the first measurement can be processed.

    Attributes
    ----------
    status : how far it is; empty when it is done
    fault : why it failed; empty where it did not
    """

    def __init__(self, log: Any, dimensions: int) -> None:
        self._log, self._dimensions = log, dimensions
        self._stopped = threading.Event()
        self.status = self.fault = ""

    def run(self, is_stop_requested: Callable[[], bool]) -> bool:
        """Load or compile the kernels in the caller's thread; False if that was stopped or failed."""
        self.status = "loading kernels"
        if not are_compiled(self._dimensions):
            self._log.info("compiling kernels, once per installation: about a minute")
        try:
            elapsed_s = warmup(lambda: self._stopped.is_set() or is_stop_requested(), self._note, self._dimensions)
        except GraphSlamError as error:  # stopped on request
            self._log.info(str(error))
            return False
        except Exception as error:
            self.fault = f"kernels cannot be compiled ({message_of(error)}): try graph_slam warmup"
            self._log.error(self.fault)
            return False
        self.status = ""
        self._log.info(f"kernels ready after {elapsed_s:.1f} s")
        return True

    def stop(self) -> None:
        """Stop compiling. The next start continues from there."""
        self._stopped.set()

    def _note(self, progress: Compiling) -> None:
        self.status = str(progress)


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

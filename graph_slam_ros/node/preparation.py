"""Loads the kernels, or compiles them at the first start, while the node answers."""

import threading
from collections.abc import Callable
from typing import Any

from graph_slam_ros.errors import GraphSlamError, message_of
from graph_slam_ros.findings.finding import Finding
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
            self.fault = message_of(error)
            self._log.error(str(Finding("not_compiled", "error", text=self.fault)))
            return False
        self.status = ""
        self._log.info(f"kernels ready after {elapsed_s:.1f} s")
        return True

    def stop(self) -> None:
        """Stop compiling. The next start continues from there."""
        self._stopped.set()

    def _note(self, progress: Compiling) -> None:
        self.status = str(progress)

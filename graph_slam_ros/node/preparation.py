"""Loading the kernels, and compiling them where that was never done, while the node answers."""

import threading
from collections.abc import Callable
from typing import Any

from graph_slam_ros.errors import GraphSlamError, message_of
from graph_slam_ros.warmup import Compiling, are_compiled, warmup


class Preparation:
    """What must be done before the first measurement is processed.

    Attributes
    ----------
    said : how far it is; empty when it is done
    fault : why it failed; empty where it did not
    """

    def __init__(self, log: Any, dimensions: int) -> None:
        self._log, self._dimensions = log, dimensions
        self._stopped = threading.Event()
        self.said = self.fault = ""

    def run(self, is_told_to_stop: Callable[[], bool]) -> bool:
        """Do it, in the thread of the caller; False where it was stopped or failed."""
        self.said = "loading kernels"
        if not are_compiled(self._dimensions):
            self._log.info("compiling kernels, once per installation: about a minute")
        try:
            took_s = warmup(lambda: self._stopped.is_set() or is_told_to_stop(), self._note, self._dimensions)
        except GraphSlamError as error:  # told to stop: as somebody wants it
            self._log.info(str(error))
            return False
        except Exception as error:
            self.fault = f"kernels cannot be compiled ({message_of(error)}): try graph_slam warmup"
            self._log.error(self.fault)
            return False
        self.said = ""
        self._log.info(f"kernels ready after {took_s:.1f} s")
        return True

    def stop(self) -> None:
        """Do not compile any further: the next start goes on from there."""
        self._stopped.set()

    def _note(self, progress: Compiling) -> None:
        self.said = str(progress)

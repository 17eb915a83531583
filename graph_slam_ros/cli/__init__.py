"""The commands ``graph_slam`` and ``graph_slam_node``.

Exit codes: 0 done, 1 internal error, 2 refused (one line names the culprit), 3 done but something was lost, 130
interrupted (Ctrl-C); of ``optimize --certify`` also 4 not certified, 5 the certificate does not apply; of ``map diff``
4 they differ; of ``check`` 4 something above a note was found.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small dense blocks: threads only cost, and reorder sums
os.environ["MPLBACKEND"] = "agg"  # pictures go into files, whatever a shell says of windows

import gc
import io
import signal
import sys
import traceback
from collections.abc import Sequence

from graph_slam_ros import progress
from graph_slam_ros.cli import console
from graph_slam_ros.errors import GraphSlamError

_OBJECTS = 50_000  # that are new before cycles are searched for: there are hardly any, and a run makes many objects


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    gc.set_threshold(_OBJECTS, 20, 50)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # what the terminal's encoding lacks is shown escaped
            stream.reconfigure(errors="backslashreplace")
    try:
        from graph_slam_ros.cli.parser import parser  # Ctrl-C while modules are imported is no traceback

        given = sys.argv[1:] if arguments is None else arguments
        args = parser(given).parse_args(given)
        progress.listeners[:] = [console.Throttled()]
        return int(args.run(args))
    except GraphSlamError as error:
        console.warn(str(error))
        return console.REFUSED
    except KeyboardInterrupt:
        console.warn("interrupted: nothing is left half-written")
        return console.INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()
        return console.DONE
    except OSError as error:
        console.warn(f"{error.filename or 'writing'}: {error.strerror}")
        return console.REFUSED
    except Exception as error:
        if os.environ.get("GRAPH_SLAM_TRACEBACK"):
            traceback.print_exc()
        what = " ".join(str(error).split())
        console.warn(f"internal error, {type(error).__name__}: {what} (GRAPH_SLAM_TRACEBACK=1 shows where)")
        return console.FAULT


def node_main() -> int:
    """Run the ROS node; without ROS, print how to install it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # nothing to tell or save while modules are imported
    if not console.has_ros():
        console.warn("ROS 2 is not installed here (no rclpy); replay works without it", "graph_slam_node")
        return console.REFUSED
    from graph_slam_ros.node.node import main as run

    return run()

"""The command ``view``: the page of a run on the loopback, with what-if and edits."""

import argparse
import contextlib
import importlib.util
import os
import sys

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.errors import GraphSlamError

_NEEDS = "starlette", "uvicorn"


def view_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``view``."""
    arguments.add_run(sub)
    arguments.add_shown(sub)
    sub.add_argument("--port", type=arguments.port, default=0, help="port to listen on (default: a free one)")
    sub.add_argument("--no-browser", action="store_true", help="print the address, and open no browser")


def view(args: argparse.Namespace) -> int:
    """Serve the page of a run until Ctrl-C."""
    if not all(map(importlib.util.find_spec, _NEEDS)):
        raise GraphSlamError("view serves its page with Starlette and uvicorn: pip install 'graph_slam_ros[view]'")
    from graph_slam_ros.tools.report.contents import read_contents
    from graph_slam_ros.tools.view.server import Access, application, listening, page_of, server
    from graph_slam_ros.tools.view.workbench import Workbench
    from graph_slam_ros.warmup import compile_all

    arguments.check_truth(args, "view")
    compile_all()
    made = read_contents(args.run_folder, args.truth, args.compare, args.plan, args.topic, align=not args.no_align)
    work = Workbench(made, arguments.LOSS_SCALE)
    page = page_of(made, work)
    bound = listening(args.port)
    access = Access(bound.getsockname()[1])
    code = console.report_losses(made.losses, made.beware)
    console.show(access.address)
    console.then("open it in a browser, once; Ctrl-C ends it")
    sys.stdout.flush()
    if not args.no_browser and _has_screen():
        import webbrowser

        webbrowser.open(access.address)
    with contextlib.suppress(KeyboardInterrupt):
        server(application(work, page, access)).run([bound])
    console.show("ended")
    return code


def _has_screen() -> bool:
    """Return whether a browser would have a window: others would run in this terminal."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))

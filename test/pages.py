"""Pages in a real browser, and runs to show on them."""

from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings

CHROMIUM = Path("/usr/bin/chromium")
PATIENCE_S = 120.0
SOFTWARE = ["--use-gl=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
HOSTILE = [
    "<script>document.title='broken'</script>",
    "\"'><img src=x onerror=\"document.title='broken'\">",
    "<a href='http://example.org'>a</a> {edge} %{x} </script>",
    "\u202eright to left\u200b",
    "x" * 10_000,
]


@contextmanager
def chromium():
    """The installed Chromium; tests are skipped where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="the page is tested with playwright")
    if not CHROMIUM.exists():
        pytest.skip(f"the page is tested with {CHROMIUM}: apt install chromium")
    with playwright.sync_playwright() as one:
        browser = one.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        yield browser
        browser.close()


@contextmanager
def pages(browser, *, offline=True):
    """A function that opens an address; at the end no page may have asked others, and nothing have failed."""
    contexts, wrong = [], []

    def go(address, place="", **options):
        context = browser.new_context(offline=offline, viewport={"width": 1400, "height": 900}, **options)
        contexts.append(context)
        context.set_default_timeout(1000.0 * PATIENCE_S)
        page = context.new_page()
        origin = address if offline else address.split("?")[0]
        page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda r: None if is_own(r.url, origin, offline) else wrong.append(r.url))
        page.goto(address + place)
        page.wait_for_selector("body[data-ready=yes]")
        return page

    yield go
    for context in contexts:
        context.close()
    assert wrong == [], wrong


def violations(page):
    """What axe finds wrong with the accessibility of a page: a line for each kind."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="accessibility is tested with axe")
    found = axe.Axe().run(page).response["violations"]
    return [f"{one['id']}: {one['help']}: {[node['html'][:200] for node in one['nodes']]}" for one in found]


def is_own(url, origin, offline):
    return url.split("#")[0] == origin if offline else url.startswith((origin, f"blob:{origin}"))


def drive(folder, names, seconds=0, dimensions=2):
    """A run of a short drive that sees landmarks with these names, and closes a loop on none."""
    config = Config.from_mapping({"world.dimensions": dimensions})
    recorder = RunRecorder(folder, config)
    slam = GraphSlam(config, sink=recorder.sink)
    for k in range(20):
        stamp = (1 + seconds) * 1_000_000_000 + k * 200_000_000
        pose = (0.3 * k, 0.0, 0.0) if dimensions == 2 else (0.3 * k, 0.0, 0.1 * k, 0.0, 0.0, 0.0, 1.0)
        recorder.record(slam, slam.process(Odometry(stamp, pose)))
        at = [(2.0 * n - 0.3 * k, 1.0 + n, 0.5)[:dimensions] for n in range(len(names))]
        noise = tuple((0.01 * np.eye(dimensions)).ravel())
        seen = tuple(Sighting(name, "position", where, noise) for name, where in zip(names, at, strict=True))
        recorder.record(slam, slam.process(Sightings(stamp, "seen", seen)))
    for control in ("end", "optimize"):
        recorder.record(slam, slam.process(Control(control)))
    recorder.save(slam)
    recorder.close()
    return folder

"""CPU time, memory and size of a report, and CPU time of Chromium to draw it: ``python -m benchmarks.report [RUN]``.

Without a run, a drive of 10,000 keyframes with four sightings each is made first: 50,000 edges. Chromium draws without
a graphics card. Its time is that of all its processes, from the start of the page to the first second in which they
rest.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

if not __package__:  # run as a script: what it imports is in the repository, not in its folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.slam import Config, Control, Odometry, Sighting, Sightings

CHROMIUM = Path("/usr/bin/chromium")
OPTIONS = ["--use-gl=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
_TICKS = os.sysconf("SC_CLK_TCK")


def drive(keyframes: int) -> Any:
    """Measurements of a drive in circles among landmarks: at each keyframe the nearest four are seen."""
    rng = np.random.default_rng(1)
    marks = rng.uniform(-30.0, 30.0, (400, 2))
    true, odom = np.array([20.0, 0.0, np.pi / 2]), np.zeros(3)
    for k in range(keyframes):
        stamp_ns = 1_000_000_000 + k * 500_000_000
        step = np.array([0.5, 0.0, 0.025 * (1.0 + 0.3 * np.sin(k / 300.0))]) if k else np.zeros(3)
        true = _moved(true, step)
        odom = _moved(odom, step + rng.normal(size=3) * [0.01, 0.01, 0.005] * (k > 0))
        yield Odometry(stamp_ns, tuple(odom.tolist()))
        near = np.argsort(np.hypot(*(marks - true[:2]).T))[:4]
        turn = np.array([[np.cos(true[2]), -np.sin(true[2])], [np.sin(true[2]), np.cos(true[2])]])
        seen = (marks[near] - true[:2]) @ turn + rng.normal(size=(4, 2)) * 0.05
        noise = (0.0025, 0.0, 0.0, 0.0025)
        several = (Sighting(f"m{m}", "position", tuple(z), noise) for m, z in zip(near, seen.tolist(), strict=True))
        yield Sightings(stamp_ns, "seen", tuple(several))
    yield from (Control("end"), Control("optimize"))


def _moved(pose: Any, step: Any) -> Any:
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return pose + np.array([cosine * step[0] - sine * step[1], sine * step[0] + cosine * step[1], step[2]])


def made(run: Path, page: Path) -> str:
    """Make the report of a run in a process of its own; returns what that took."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "graph_slam_ros.cli", "report", run, "--out", page], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return f"made in {cpu_s:.1f} s of CPU with {after.ru_maxrss / 1e3:.0f} MB; {page.stat().st_size / 1e6:.1f} MB"


def drawn(page: Path) -> str:
    """Draw a page; returns what that took."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as one:
        browser = one.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        tab = browser.new_page(viewport={"width": 1400, "height": 900})
        begin_s = _of_chromium()
        tab.goto(page.as_uri())
        tab.wait_for_selector("body[data-ready=yes]", timeout=120_000)
        now_s, before_s = _of_chromium(), 0.0
        while now_s - before_s > 0.05:
            time.sleep(1.0)
            before_s, now_s = now_s, _of_chromium()
        heap = tab.evaluate("performance.memory.usedJSHeapSize")
        browser.close()
    return f"drawn in {now_s - begin_s:.1f} s of CPU with a heap of {heap / 1e6:.0f} MB"


def _of_chromium() -> float:
    """CPU time of all processes of Chromium that this one has started [s]."""
    parent, used_s, names = dict[int, int](), dict[int, float](), dict[int, str]()
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, _, rest = file.read_text().partition("(")[2].rpartition(")")
        except OSError:  # it has ended
            continue
        fields, pid = rest.split(), int(file.parent.name)
        names[pid], parent[pid] = name, int(fields[1])
        used_s[pid] = (int(fields[11]) + int(fields[12])) / _TICKS

    def is_ours(pid: int) -> bool:
        while pid in parent and pid != os.getpid():
            pid = parent[pid]
        return pid == os.getpid()

    return sum(used_s[pid] for pid, name in names.items() if "chrom" in name and is_ours(pid))


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", nargs="?", type=Path, metavar="RUN", help="a run (default: a drive is made)")
    parser.add_argument("--keyframes", type=int, default=10_000, metavar="N", help="of the drive that is made")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        run = args.run or Path(scratch) / "run"
        if args.run is None:
            record_run(run, Config(), drive(args.keyframes), [])
        page = Path(scratch) / "run.html"
        print(made(run, page))
        print(drawn(page))


if __name__ == "__main__":
    main()

"""Draw all pictures of the README and of docs/ again: ``make pictures``.

The drive of the demonstration, a page of its report, and the repair of a map step by step (docs/repair.md) in Chromium.
"""

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
DOCS, BAG = ROOT / "docs", ROOT / "data/demo.mcap"
CHROMIUM = "/usr/bin/chromium"
SOFTWARE = ["--use-gl=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
_WIDTH, _COLOURS = 1280, 256


def graph_slam(*words: Any) -> None:
    """Run a command, which has to succeed."""
    subprocess.run(
        [sys.executable, "-m", "graph_slam_ros.cli", *map(str, words)], check=True, stdout=subprocess.DEVNULL
    )


def keep(page: Any, name: str, height: int = 800) -> None:
    """Write what is seen of a page, with few colours."""
    file = DOCS / name
    page.mouse.move(5, height - 5)  # off the map, whose buttons it would show
    page.wait_for_timeout(500)
    page.screenshot(path=file, clip={"x": 0, "y": 0, "width": _WIDTH, "height": height})
    with Image.open(file) as shot:
        few = shot.convert("RGB").quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(file, optimize=True)


def to_top(page: Any, which: str) -> None:
    """Scroll until an element is at the top."""
    page.evaluate(f"document.querySelector('{which}').scrollIntoView()")


@contextmanager
def viewed(run: Path) -> Iterator[str]:
    """The address of a run that is served."""
    words = [sys.executable, "-m", "graph_slam_ros.cli", "view", str(run), "--no-browser"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        yield next(found[0] for line in server.stdout if (found := re.search(r"http://\S+", line)))
        server.terminate()


def demonstration(scratch: Path, browser: Any) -> None:
    """Draw the drive, its animation, and its report."""
    run = scratch / "demo"
    graph_slam("replay", BAG, "--out", run)
    graph_slam("map", "export", run, "--truth", BAG, "--out", DOCS / "demo.png", "--force")
    with Image.open(DOCS / "demo.png") as picture:
        small = picture.convert("RGB").resize(
            (800, round(800 * picture.height / picture.width)), Image.Resampling.LANCZOS
        )
        few = small.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(DOCS / "demo.png", optimize=True)
    graph_slam("map", "export", run, "--truth", BAG, "--out", DOCS / "demo.gif", "--force")
    graph_slam("report", run, "--truth", BAG, "--out", scratch / "demo.html")
    page = browser.new_page(viewport={"width": _WIDTH, "height": 900})
    page.goto((scratch / "demo.html").as_uri() + "#edge=900")
    page.wait_for_selector("body[data-ready=yes]")
    page.evaluate("Plotly.relayout('map', {'xaxis.autorange': true, 'yaxis.autorange': true})")
    page.evaluate("scrollTo(0, 0)")
    keep(page, "report.png", 860)


def repair(scratch: Path, browser: Any) -> None:
    """Repair a map with planted wrong closures through its page, a picture for each step."""
    subprocess.run([sys.executable, ROOT / "test/planted_closures.py", scratch / "planted"], check=True)

    def solved() -> None:
        page.wait_for_timeout(200)
        page.wait_for_selector("body:not([data-solved=no])")

    with viewed(scratch / "planted/run") as address:
        page = browser.new_page(viewport={"width": _WIDTH, "height": 900})
        page.goto(address)
        page.wait_for_selector("body[data-ready=yes]")
        keep(page, "repair_1.png", 860)
        page.click("#verdict a")
        keep(page, "repair_2.png", 240)
        boxes = page.locator("#groups input")
        boxes.nth(0).click()
        solved()
        keep(page, "repair_3.png", 700)
        boxes.nth(0).click()
        solved()
        boxes.nth(1).click()
        solved()
        keep(page, "repair_4.png", 700)
        page.fill("#who", "Anna")
        page.fill("#reason", "the fourth aisle was taken for the second")
        page.click("#save")
        page.wait_for_function("document.getElementById('saved').innerText.startsWith('Saved')")
        page.evaluate("""for (const one of document.querySelectorAll('#saved p')) one.textContent =
            one.textContent.replaceAll(/\\S*\\/planted\\//g, 'planted/')""")  # not where it was drawn
        to_top(page, "#edit-panel")
        keep(page, "repair_5.png", 560)


def main() -> None:
    """Draw everything."""
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as one:
        browser = one.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        demonstration(Path(scratch), browser)
        repair(Path(scratch), browser)
        browser.close()


if __name__ == "__main__":
    main()

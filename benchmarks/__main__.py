"""Everything, into docs/benchmarks.md, docs/accuracy.md and docs/lifelong.md: ``make bench``.

What follows on the command line goes to each programme that races, e.g. ``python -m benchmarks --poses 400`` for a
short look.
"""

import json
import subprocess
import sys

from benchmarks import table
from benchmarks.fresh import ROOT

_RESULTS = ROOT / "benchmarks/results"


def main() -> None:
    """One programme after the other; what is done is in the document even if the next is stopped."""
    races = (["batch"], ["online"], ["online", "--no-path"])
    lifelong = ["lifelong", "--keyframes", "50000", "--seeds", "1", "--windows", "60"]
    for programme in (*races, ["consistency"], ["marginals"], lifelong):
        asked = sys.argv[1:] if programme in races else []
        path = _RESULTS / f"{''.join(programme)}.json"
        subprocess.run(
            [sys.executable, "-m", f"benchmarks.{programme[0]}", *programme[1:], *asked, "--json", str(path)],
            cwd=ROOT,
            check=True,
        )
        table.into_document(json.loads(path.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()

"""Everything, into docs/benchmarks.md: ``make bench``.

What follows on the command line goes to each programme, e.g. ``python -m benchmarks --poses 400`` for a short look.
"""

import json
import subprocess
import sys

from benchmarks import table
from benchmarks.fresh import ROOT

_RESULTS = ROOT / "benchmarks/results"


def main() -> None:
    """One programme after the other; what is done is in the document even if the next is stopped."""
    for name, *more in (["batch"], ["online"], ["online", "--no-path"], ["memory"], ["growth"]):
        path = _RESULTS / f"{name}{''.join(more)}.json"
        subprocess.run(
            [sys.executable, "-m", f"benchmarks.{name}", *more, *sys.argv[1:], "--json", str(path)],
            cwd=ROOT,
            check=True,
        )
        table.into_document(json.loads(path.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()

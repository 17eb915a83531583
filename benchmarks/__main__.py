"""Everything, into docs/benchmarks.md: ``make bench``."""

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
        subprocess.run([sys.executable, "-m", f"benchmarks.{name}", *more, "--json", str(path)], cwd=ROOT, check=True)
        table.into_document(json.loads(path.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()

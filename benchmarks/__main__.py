"""Everything, into docs/benchmarks.md, docs/accuracy.md and docs/lifelong.md: ``make bench``.

What follows on the command line goes to each programme that races, e.g. ``python -m benchmarks --poses 400`` for a
short look. What is done is in the document even if the next is stopped.
"""

import json
import subprocess
import sys

from benchmarks import table
from benchmarks.fresh import ROOT

if __name__ == "__main__":
    for name, words in {
        "batch": sys.argv[1:],
        "online": sys.argv[1:],
        "consistency": [],
        "marginals": [],
        "lifelong": ["--keyframes", "50000", "--seeds", "1", "--windows", "60"],
    }.items():
        path = ROOT / f"benchmarks/results/{name}.json"
        subprocess.run([sys.executable, "-m", f"benchmarks.{name}", *words, "--json", str(path)], cwd=ROOT, check=True)
        table.into_document(json.loads(path.read_text(encoding="utf-8")))

"""Check that no folder has more lines of Python than its budget, and that no budget has grown.

``python tools/budget.py`` compares; with ``--lower`` it writes today's lines where they are fewer. The table is
``tools/budget.csv``: a folder, and its most lines. A row ``docs`` counts words of the pages.
"""

import csv
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "tools/budget.csv"


def size_of(name: str) -> int:
    """Lines of Python in a folder, without rows below it that are files; for ``docs`` the words of the pages."""
    if name == "docs":
        return sum(len(page.read_text(encoding="utf-8").split()) for page in (ROOT / name).glob("*.md"))
    folder, pattern = (ROOT / name[:-2], "*.py") if name.endswith("/*") else (ROOT / name, "**/*.py")
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in folder.glob(pattern))


def read(text: str) -> dict[str, int]:
    """Budgets by folder."""
    return {name: int(most) for name, most in list(csv.reader(text.splitlines()))[1:]}


def lowest() -> dict[str, int]:
    """The smallest budget that each folder had in any commit, as far as this checkout has them."""
    name = TABLE.relative_to(ROOT).as_posix()
    log = subprocess.run(["git", "log", "--format=%H", "--", name], cwd=ROOT, capture_output=True, text=True)
    least: dict[str, int] = {}
    for commit in log.stdout.split():
        shown = subprocess.run(["git", "show", f"{commit}:{name}"], cwd=ROOT, capture_output=True, text=True)
        for folder, most in read(shown.stdout).items():
            least[folder] = min(most, least.get(folder, most))
    return least


def unlisted(budgets: dict[str, int]) -> list[str]:
    """Folders of the package without a row."""
    package = ROOT / "graph_slam_ros"
    folders = [path.parent for path in package.glob("*/__init__.py")]
    folders += [path.parent for path in package.glob("tools/*/__init__.py")]
    return [name for folder in folders if (name := folder.relative_to(ROOT).as_posix()) not in budgets]


def main(arguments: list[str]) -> int:
    """Print what is over; returns the exit code."""
    budgets = read(TABLE.read_text(encoding="utf-8"))
    sizes = {name: size_of(name) for name in budgets}
    if "--lower" in arguments:
        rows = [f"{name},{min(most, sizes[name])}" for name, most in budgets.items()]
        TABLE.write_text("\n".join(["folder,lines", *rows]) + "\n", encoding="utf-8")
        return 0
    least = lowest()
    wrong = [f"{name}: {sizes[name]}, and its budget is {most}" for name, most in budgets.items() if sizes[name] > most]
    wrong += [
        f"{name}: a budget of {most}, and it was {least[name]}"
        for name, most in budgets.items()
        if most > least.get(name, most)
    ]
    wrong += [f"{name}: no budget" for name in unlisted(budgets)]
    for line in wrong:
        print(f"tools/budget.csv: {line}")
    if not wrong:
        print(f"{sizes['graph_slam_ros']} lines of the package, {sizes['test']} of tests: within their budgets")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

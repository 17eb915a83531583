"""docs/check.md has a row for each finding: ``PYTHONPATH=test python test/unit/check/test_check_page.py``."""

import re

from places import ROOT

from graph_slam_ros.findings.table import CHECKED

PAGE = ROOT / "docs/check.md"
HEAD = "| finding | what was measured | what mends it |\n|---|---|---|\n"


def table(text):
    """A row for each finding, of which the page says what was measured; those that end the list are marked."""
    ends, said = " (ends the list)", dict(re.findall(r"^\| `(\w+)`.*? \| (.*?) \| .* \|$", text, re.M))
    rows = (f"| `{name}`{ends * row.ends} | {said[name]} | {row.remedy} |" for name, row in CHECKED.items())
    return HEAD + "\n".join(rows) + "\n"


def written(text):
    return re.sub(re.escape(HEAD) + r"(\|.*\n)*", lambda _: table(text), text)


def test_every_finding_is_on_the_page():
    text = PAGE.read_text()
    assert text == written(text), "PYTHONPATH=test python test/unit/check/test_check_page.py writes the table"


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text()))

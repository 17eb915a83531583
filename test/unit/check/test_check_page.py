"""docs/check.md has a row for each finding: ``PYTHONPATH=test python test/unit/check/test_check_page.py``."""

import re

from places import ROOT

from graph_slam_ros.check.finding import KINDS

PAGE = ROOT / "docs/check.md"
HEAD = "| finding | what was measured | what mends it |\n|---|---|---|\n"


def table():
    """A row for each finding; those that end the list are marked."""
    ends = " (ends the list)"
    rows = (f"| `{name}`{ends if row.ends else ''} | {row.meaning} | {row.mend} |" for name, row in KINDS.items())
    return HEAD + "\n".join(rows) + "\n"


def written(text):
    """The page with the table as it should be."""
    return re.sub(re.escape(HEAD) + r"(\|.*\n)*", lambda _: table(), text)


def test_every_finding_is_on_the_page():
    text = PAGE.read_text()
    assert text == written(text), "PYTHONPATH=test python test/unit/check/test_check_page.py writes the table"


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text()))

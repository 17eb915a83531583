"""Links lead to a file and a heading, figures are those of docs/figures, and each case of reliability.md has a test."""

import fnmatch
import re
from collections import Counter
from pathlib import Path
from urllib.parse import unquote

from places import ROOT
from rows import each

from benchmarks import table
from benchmarks.figure_rows import read_table
from graph_slam_ros.messages.inputs import CONVERTERS

DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
_INLINE = re.compile(r"\]\(\s*<?([^()\s<>]+(?:\([^()\s]*\)[^()\s]*)*)>?(?:\s+[\"'][^)]*)?\s*\)")
_REFERENCE = re.compile(r"^ {0,3}\[[^\]]+\]:\s*<?([^\s>]+)", re.MULTILINE)
_HTML = re.compile(r"<[^>]*\b(?:href|src|srcset)=\"([^\"]+)\"")
_ELSEWHERE = re.compile(r"[a-z][a-z0-9+.-]*:", re.IGNORECASE)


def prose(text):
    """Without code, in which nothing is a link or a heading."""
    text = re.sub(r"^( *)(```+|~~~+).*?^ *\2[`~]*$", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"(?<!`)(`+)(?!`).*?(?<!`)\1(?!`)", lambda code: "x" * len(code[0]), text, flags=re.DOTALL)


def links(text):
    """Targets of links and pictures, but for those on other machines."""
    text = prose(text)
    found = [*_INLINE.findall(text), *_REFERENCE.findall(text), *_HTML.findall(text)]
    return [target for target in found if not _ELSEWHERE.match(target)]


def anchors(text):
    """What follows # in links to headings, by the rules of GitHub."""
    found = set(re.findall(r"<a (?:name|id)=\"([^\"]+)\"", text))
    text, seen = re.sub(r"^( *)(```+|~~~+).*?^ *\2[`~]*$", "", text, flags=re.MULTILINE | re.DOTALL), {}
    for heading in re.findall(r"^#{1,6} +(.*?)(?: +#+)? *$", text, re.MULTILINE):
        heading = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        count = seen[slug] = seen.get(slug, -1) + 1
        found.add(f"{slug}-{count}" if count else slug)
    return found


def broken(document):
    """Links of a document that lead nowhere."""
    for link in links(document.read_text(encoding="utf-8")):
        path, _, anchor = unquote(link).partition("#")
        target = document.parent / path if path else document
        if not target.exists():
            yield f"{link}: there is no {path}"
        elif anchor and (target.suffix != ".md" or anchor not in anchors(target.read_text(encoding="utf-8"))):
            yield f"{link}: {target.name} has no heading #{anchor}"


@each("document", DOCUMENTS)
def test_each_link_of_a_document_leads_somewhere(document):
    assert list(broken(document)) == []


def test_the_front_page_has_links_to_every_document():
    linked = {link.partition("#")[0] for document in DOCUMENTS for link in links(document.read_text(encoding="utf-8"))}
    assert {Path(link).name for link in linked} >= {document.name for document in (ROOT / "docs").glob("*.md")}


CASES = {"A": 33, "B": 23, "G": 22, "P": 24, "F": 36, "X": 14}


def test_every_case_of_what_can_go_wrong_is_told_with_a_test_that_is_there_or_a_reason():
    named = set(
        re.findall(r"^def (test_\w+)", "\n".join(f.read_text() for f in (ROOT / "test").rglob("test_*.py")), re.M)
    )
    told = []
    for line in (ROOT / "docs/reliability.md").read_text().splitlines():
        cases = re.findall(r"\b([ABGPFX])(\d+)(?:-[A-Z](\d+))?", line.split(" | ")[0])
        if line.startswith("| ") and cases:
            tests = re.findall(r"\b(test_[\w*]+)(?!\w|\*|\.py)", line.rsplit(" | ", 1)[1])
            assert all(fnmatch.filter(named, test) for test in tests), tests
            assert tests or re.search("[Oo]therwise|Not done", line), line
            told += [f"{letter}{k}" for letter, first, last in cases for k in range(int(first), int(last or first) + 1)]
    assert [case for case, times in Counter(told).items() if times > 1] == []  # a code names one row
    assert set(told) >= {f"{letter}{k}" for letter, count in CASES.items() for k in range(1, count + 1)}


def test_every_table_of_figures_is_that_of_its_csv_whose_rows_have_commands():
    text = "".join(page.read_text(encoding="utf-8") for page in table.PAGES)
    assert table.rendered(text) == text, "python -m benchmarks.table"
    shown = set(re.findall(r"<!-- (\S+): begin -->", text))
    assert shown == {file.stem for file in table.FIGURES.glob("*.csv")} - {"figures"}
    assert all(row[table.COMMAND] and row[table.MEASURED] for name in shown for row in table.read(name))


def test_what_the_front_page_claims_is_what_the_tables_say():
    online = {row["graph"]: row for row in table.read("online") if row["part"]}
    of_125, of_9 = (online.pop(name) for name in ("smallGrid3D", "tinyGrid3D"))
    parts = [row["part"] for row in online.values()]
    off = max(float(row["of best, ours"]) for row in (*online.values(), of_125))
    hour = next(row["CPU (s)"] for row in table.read("replay") if row["recording"] == "hour")
    kills = re.search(r"`kill -9`.* \| ([\d,]+) \|", (ROOT / "docs/reliability.md").read_text())[1]
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    for claim in (
        f"it takes {min(parts)} to {max(parts)} of the CPU time",
        f"(Victoria Park {online['victoria_park']['part']}, M3500 {online['M3500']['part']})",
        f"on a graph of 125 poses {of_125['part']}, and on one of 9 poses {of_9['part']}",
        f"at most {100 * off - 100:.2f} % above",
        f"on the 9 poses {100 * float(of_9['of best, ours']) - 100:.2f} %",
        f"killed {kills} times",
        f"takes {float(hour):.0f} s of CPU time",
        f"[{len(CONVERTERS)} message types]",
    ):
        assert claim in text
    for row in table.read("robots"):
        for column, name in (("estimate (m)", "position"), ("landmarks (m)", "map")):
            figure = read_table()[f"MR.CLAM 7, robot {row['robot']}, ids known: {name}"]
            assert row[column] == f"{figure.value:.3f}"

"""Each link within the documents leads to a file that is there, and to a heading that is in it."""

import re
from pathlib import Path
from urllib.parse import unquote

import pytest
from places import ROOT

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


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda document: document.name)
def test_each_link_of_a_document_leads_somewhere(document):
    assert list(broken(document)) == []


def test_the_front_page_has_links_to_every_document():
    linked = {link.partition("#")[0] for document in DOCUMENTS for link in links(document.read_text(encoding="utf-8"))}
    assert {Path(link).name for link in linked} >= {document.name for document in (ROOT / "docs").glob("*.md")}


@pytest.mark.parametrize(
    "text",
    [
        *("[x](missing.md)", "![x](missing.png)", "[x](#none)", "[x](a.md#none)", "[x](<missing.md> 'title')"),
        *('<img src="missing.png">', "[x]: missing.md", "[a [b](c.md)](missing.md)", "[`x`](missing.md)"),
    ],
)
def test_a_link_that_leads_nowhere_is_found(text, tmp_path):
    (tmp_path / "a.md").write_text("# There\n")
    (tmp_path / "c.md").write_text("")
    (tmp_path / "b.md").write_text(f"# Top\n\n{text}\n")
    assert len(list(broken(tmp_path / "b.md"))) == 1


def test_a_link_that_leads_somewhere_is_none_of_them(tmp_path):
    (tmp_path / "a.md").write_text("# The `a` of *it*: 1.5 x (all)\n\n## Again\n\n## Again\n")
    text = "[x](a.md#the-a-of-it-15-x-all) [x](a.md#again-1) [x](https://example.org/#x) `[x](y.md)`\n"
    (tmp_path / "b.md").write_text(f"{text}\n```\n[x](y.md)\n# Not\n```\n")
    assert list(broken(tmp_path / "b.md")) == []

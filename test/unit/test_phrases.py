"""Texts that a user reads stand alone, and have no private words: helps of parameters and options, messages, pages."""

import ast
import re

import pytest
from places import ROOT

from graph_slam_ros.config.config import parameters
from graph_slam_ros.measurements.reasons import REASONS

PACKAGE = ROOT / "graph_slam_ros"
ELSEWHERE = {"graph", "lie", "solver"}  # folders that are not checked
# Tables of figures, and cases by number: they are no prose.
FIGURES = {"accuracy.md", "benchmarks.md", "reliability.md", "robustness.md", "solver.md"}
PHRASES = re.compile(
    r"\b(see above|see below|and of the rotation|fault of ours|told|tells?|hears?|heard|beside|whoever|whom|settled?|"
    r"says? so of|given up|let go of)\b",
    re.IGNORECASE,
)


def wrong(text):
    return [found[0] for found in PHRASES.finditer(text)]


def test_phrases_are_found():
    assert wrong("Noise, see above, as it is told.") == ["see above", "told"]
    assert not wrong("The noise of the message; storytelling is fine.")


@pytest.mark.parametrize("parameter", list(parameters()), ids=lambda one: one.name)
def test_the_help_of_a_parameter_stands_alone(parameter):
    assert not wrong(parameter.meaning)
    assert not re.match(r"(and|or|the same|likewise|ditto|as)\b", parameter.meaning), "it begins with what it is"


def test_meanings_and_remedies_of_counters_stand_alone():
    assert not {name: wrong(f"{row.meaning} {row.remedy}") for name, row in REASONS.items() if wrong(str(row))}


def texts(tree):
    """Every string with a space in it that is no docstring."""
    documented = (ast.Module, ast.FunctionDef, ast.ClassDef)
    first = (node.body[0] for node in ast.walk(tree) if isinstance(node, documented) and node.body)
    docstrings = {id(one.value) for one in first if isinstance(one, ast.Expr)}
    for node in ast.walk(tree):
        match node:
            case ast.Constant(value=str(text)) if " " in text and id(node) not in docstrings:
                yield node.lineno, text


def test_messages_have_no_private_words():
    found = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        name = file.relative_to(PACKAGE)
        if name.parts[0] not in ELSEWHERE:
            found |= {f"{name}:{line}": text for line, text in texts(ast.parse(file.read_text())) if wrong(text)}
    assert not found


@pytest.mark.parametrize(
    "page",
    [*ROOT.glob("*.md"), *(one for one in sorted((ROOT / "docs").glob("*.md")) if one.name not in FIGURES)],
    ids=lambda page: page.name,
)
def test_a_page_has_no_private_words(page):
    prose = re.sub(r"^( *)```.*?^ *```$|`[^`\n]*`", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    assert not [line for line in prose.splitlines() if wrong(line)]

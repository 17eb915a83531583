"""The field's words: no private verbs in identifiers, no docstring that begins with a fragment."""

import ast
import re

import pytest
from places import ROOT

PACKAGE = ROOT / "graph_slam_ros"
BANNED = {
    *("take", "takes", "took", "taken", "tell", "tells", "told", "hear", "heard", "beside", "settle", "settled"),
    *("look", "looks", "looked", "loose", "say", "says", "said", "believe", "believed", "waiting"),
}
PHRASES = ("take_up", "give_up", "let_in", "put_in")
KEPT = {  # parameters, what the library documents, and files of the standard library
    *("second_look_after", "give_up_s", "max_waiting", "waiting", "tell"),
    *("take_along_axis",),  # NumPy's
    *("took", "let_in"),  # the time of a run in its summary; edges of a what-if
}
FRAGMENT = re.compile(
    r"(Of|What|Those|These|From|As|Whether|Which|Where|Who|Whose|Whom|By|With|Without|In|On|At|And|But|How|Why|When|While|"
    r"Until|Since|After|Before|Else|Between|Among|Towards|If|So|Than|For|To|Not|That|Again|Then)\b"
)


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def words(name):
    """Of an identifier: ``_take_up`` and ``TakeUp`` have take and up."""
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())


def names(tree):
    """Every identifier that a module defines or uses."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node
        elif isinstance(node, ast.arg):
            yield node.arg, node
        elif isinstance(node, ast.Attribute):
            yield node.attr, node
        elif isinstance(node, ast.Name):
            yield node.id, node


def is_banned(name):
    return name not in KEPT and (not BANNED.isdisjoint(words(name)) or any(one in name for one in PHRASES))


@pytest.mark.parametrize(
    "name", ["take", "_take_up", "give_up", "is_settled", "_LOOKED_AT", "ToldAgain", "waiting_for"]
)
def test_private_verbs_are_found(name):
    assert is_banned(name)


@pytest.mark.parametrize("file", modules(), ids=lambda file: str(file.relative_to(PACKAGE)))
def test_identifiers_and_docstrings_have_the_words_of_the_field(file):
    tree = ast.parse(file.read_text())
    wrong = sorted({f"{node.lineno}: {name}" for name, node in names(tree) if is_banned(name)})
    assert not wrong, "private verbs: see docs/glossary.md"
    documented = (node for node in ast.walk(tree) if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef))
    texts = {node.body[0].lineno: text for node in documented if (text := ast.get_docstring(node))}
    fragments = [f"{line}: {text.splitlines()[0]}" for line, text in texts.items() if FRAGMENT.match(text)]
    assert not fragments, "a docstring begins with a subject or a verb"

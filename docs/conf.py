"""The pages as a site, by Sphinx: ``make site``. On GitHub they are read as they are."""

import re
from importlib.metadata import metadata
from pathlib import Path
from typing import Any

import numpy.typing
from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

_about = metadata("graph_slam_ros")
project = "graph_slam_ros"
author = copyright = _about["Author"]
release = version = _about["Version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
myst_enable_extensions = ["html_image"]
myst_heading_anchors = 4
autodoc_mock_imports = ["dask", "distributed", "fsspec", "jinja2", "pyarrow"]  # the extra `fleet`
autodoc_preserve_defaults = True
html_theme = "furo"
html_title = f"{project} {version}"

_FILES = f"{_about['Home-page']}/blob/{version}"
_README = (Path(__file__).resolve().parent.parent / "README.md").read_text(encoding="utf-8")


class Array:
    """What the API calls an array of any numbers, instead of the twelve types of NumPy."""

    def __class_getitem__(cls, numbers: Any) -> type:
        """Return the same of any numbers."""
        return cls


class ArrayLike:
    """What NumPy makes an array of."""


numpy.typing.NDArray, numpy.typing.ArrayLike = Array, ArrayLike


def _read(app: Sphinx, page: str, source: list[str]) -> None:
    """Lead links to folders, and out of docs/, into the repository; the front page is README, and the list of pages."""
    text = source[0].replace("](../", f"]({_FILES}/")
    text = re.sub(r"\]\((\w+/?)\)", rf"]({_FILES}/docs/\1)", text)
    if page == "index":
        pages = "\n".join(re.findall(r"\]\((\w+)\.\w+\)", text))
        readme = re.sub(r'(\]\(|src=")docs/', r"\1", _README.partition("\n## Documentation")[0])
        readme = re.sub(r"\]\((\w+/|[A-Z])", rf"]({_FILES}/\1", readme)
        text = f"{readme}\n#{text}\n```{{toctree}}\n:hidden:\n{pages}\n```\n"
    source[0] = text


def _document(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Show ``name : meaning`` as such: types are in the signatures, and Napoleon expects them beside the colon."""
    lines[:] = re.sub(r"(?m)^(\w[\w, ]*) : (.+)$", r"\1\n    \2", "\n".join(lines)).split("\n")


def _sign(app: Sphinx, what: str, name: str, thing: Any, options: Any, signature: str | None, returned: str) -> Any:
    """Let defaults that are no Python not hide the types."""
    return signature and signature.replace("<factory>", "..."), returned


def setup(app: Sphinx) -> None:
    """Connect what is done before a page or a docstring is parsed."""
    app.add_lexer("csv", TextLexer)
    app.connect("source-read", _read)
    app.connect("autodoc-process-docstring", _document, priority=400)  # before Napoleon's
    app.connect("autodoc-process-signature", _sign)

"""Plugins of other packages: Python entry points, looked up by group and name.

A plugin is imported when its name is first used. A built-in name is never looked up.
"""

import sys
from collections.abc import Callable, Container
from functools import lru_cache
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from typing import Any

from graph_slam_ros.errors import ConfigError

INPUTS = "graph_slam_ros.inputs"  # of types of messages: their names with dots, package.msg.Name
EDGES = "graph_slam_ros.edges"  # of edge types: their tags in g2o files


def names(group: str) -> dict[str, str]:
    """Return the names in a group with the distribution of each; nothing is imported."""
    return {entry.name: _distribution(entry) for entry in _installed(group, tuple(sys.path))}


def described(group: str, built_in: Container[str], say: Callable[[str, str], str]) -> list[str]:
    """Return a line for each plugin of a group, by name, that ``say`` makes of name and distribution, or its fault.

    Plugins of names that are ``built_in`` are not used.
    """
    lines = []
    for name, distribution in sorted(names(group).items()):
        if name in built_in:
            lines.append(f"{name}: the plugin of {distribution} is not used: it is built in")
            continue
        try:
            lines.append(say(name, distribution))
        except ConfigError as error:
            lines.append(str(error))
    return lines


@lru_cache(4)
def _installed(group: str, path: tuple[str, ...]) -> EntryPoints:
    return entry_points(group=group)


def load(group: str, name: str, check: Callable[[Any], str]) -> tuple[Any, str] | None:
    """Import what a plugin has under a name: the object, and the words that name it; None where there is none.

    ``check`` says what is wrong with the object. Raises ConfigError: it cannot be imported, is not what the group is
    for, or two distributions have the name.
    """
    found = sorted(set(_installed(group, tuple(sys.path)).select(name=name)), key=_distribution)
    if not found:
        return None
    if len(found) > 1:
        raise ConfigError(f"{name}: plugins of {' and '.join(map(_distribution, found))} have it: uninstall one")
    plugin = f"plugin {found[0].value} of {_distribution(found[0])}"
    try:
        there = found[0].load()
        wrong = check(there)
    except (Exception, SystemExit) as error:  # whatever another's module does when it is imported
        raise ConfigError(f"{name}: {plugin} cannot be loaded: {in_one_line(error)}") from error
    if wrong:
        raise ConfigError(f"{name}: {plugin}: {wrong}")
    return there, plugin


def in_one_line(error: BaseException) -> str:
    """An exception of a plugin: its type, and its words without their line breaks."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _distribution(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown distribution"

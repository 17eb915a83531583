"""Types of messages that other packages read: entry points of the group ``graph_slam_ros.inputs``."""

import inspect
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from graph_slam_ros import edge_tags, plugins
from graph_slam_ros.findings.table import COUNTED
from graph_slam_ros.measurements.types import AngularVelocity, Closure, Fix, Measured, Odometry, to_record
from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.landmarks import ObservedLandmark, sightings
from graph_slam_ros.messages.inputs.source import InputContext, NotYet
from graph_slam_ros.plugins import INPUTS, in_one_line, load, names

_YIELDS: Mapping[str, type] = {
    "landmarks": ObservedLandmark,
    "fix": Fix,
    "closure": Closure,
    "odometry": Odometry,
    "gyro": AngularVelocity,
}


@dataclass(frozen=True, slots=True)
class InputType:
    """The converters of a type of messages: the object that an entry point names.

    Attributes
    ----------
    converters : by use (``landmarks``, ``fix``, ``closure``, ``odometry``, ``gyro``; the first is that of ``auto``),
        a function of ``InputContext`` and a message that yields ``ObservedLandmark``, ``Fix``, ``Closure``,
        ``Odometry`` or ``AngularVelocity``. It raises ``MessageError(reason)`` for a message that is to be refused
    definition : the text of its .msg file, for recordings that hold no definitions; types of other packages that ROS
        does not have follow it, each after a line of ``=`` and one of ``MSG: package/Name``
    """

    converters: Mapping[str, Callable[[InputContext, Any], Iterable[Any]]]
    definition: str = ""


class PluginFault(MessageError):
    """A message on which a plugin failed. Its text names the plugin and the error."""


_loaded: dict[str, tuple[InputType, str]] = {}


def input_type(type_name: str) -> InputType | None:
    """Return the plugin's input type for ``package/msg/Name``; None if there is none.

    Raises
    ------
    ConfigError
        The plugin cannot be used.
    """
    if type_name not in _loaded:
        found = load(INPUTS, type_name.replace("/", "."), _wrong)
        if found is None:
            return None
        _loaded[type_name] = found
    return _loaded[type_name][0]


def converters(type_name: str) -> Mapping[str, Callable[[InputContext, Any], Iterable[Measured]]] | None:
    """Return a plugin's converters of a type by use; they raise ``PluginFault``. Raises as ``input_type``."""
    found = input_type(type_name)
    if found is None:
        return None
    plugin = _loaded[type_name][1]
    return {use: partial(_converted, plugin, use, read) for use, read in found.converters.items()}


def types() -> set[str]:
    """Return the types of installed plugins, usable or not."""
    return {name.replace(".", "/") for name in names(INPUTS)}


def described(built_in: Iterable[str]) -> list[str]:
    """Return a line for each type of an installed plugin, with the reason if it cannot be used."""

    def description(name: str, distribution: str) -> str:
        type_name = name.replace(".", "/")
        found = input_type(type_name)
        return f"{type_name}: read by {distribution} as {' or '.join(found.converters if found else ())}"

    return plugins.described(INPUTS, {one.replace("/", ".") for one in built_in}, description) + edge_tags.described()


def _wrong(there: Any) -> str:
    if not isinstance(there, InputType):
        return f"it is a {type(there).__name__}, not an InputType"
    if not isinstance(there.converters, Mapping) or not there.converters or not set(there.converters) <= set(_YIELDS):
        return f"its converters are not a dictionary by {', '.join(_YIELDS)}"
    if not isinstance(there.definition, str):
        return "its definition is not a text"
    for use, read in there.converters.items():
        try:
            inspect.signature(read).bind(None, None)
        except TypeError as error:
            return f"its converter of {use} is not a function of an InputContext and a message: {error}"
    return ""


def _converted(
    plugin: str,
    use: str,
    read: Callable[[InputContext, Any], Iterable[Any]],
    source: InputContext,
    message: Any,
) -> list[Measured]:
    try:
        found = list(read(source, message))
        for one in found:
            if not isinstance(one, _YIELDS[use]):
                raise PluginFault(f"{plugin}: as {use} it gives a {type(one).__name__}, not {_YIELDS[use].__name__}")
        out: list[Measured] = list(sightings(source, found)) if use == "landmarks" else found
        for measured in out:
            if getattr(measured, "topic", getattr(measured, "source", None)) != source.name:
                raise PluginFault(f"{plugin}: the topic or source of what it gives is not {source.name!r}")
            json.dumps(to_record(measured))  # as the journal keeps it
    except NotYet:
        raise
    except MessageError as reason:
        if isinstance(reason, PluginFault) or str(reason) in COUNTED:
            raise
        raise PluginFault(f"{plugin} refuses a message: {' '.join(str(reason).split())}") from None
    except Exception as error:  # whatever another's function does
        raise PluginFault(f"{plugin}: {in_one_line(error)}") from error
    return out

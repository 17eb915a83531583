"""ROS parameters, declared from the configuration tree with description, unit and range, and read back into it."""

import sys
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from graph_slam_ros.config.config import Config, flatten, parameters
from graph_slam_ros.config.parameter import Parameter
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.formats.files import read_text

_NODE = "{node}"  # in output.folder
_OTHERS = {"use_sim_time", "start_type_description_service"}  # rclpy's own
_AT_START = {"inputs.names", "output.folder", "node.autostart", "landmarks.surveyed_file"}
"""Sections are declared by the first; what nobody may point elsewhere from outside is the second."""


def declare_parameters(node: Any) -> Config:
    """Declare every parameter on a node, and return the configuration with the values that it was started with.

    Raises
    ------
    ConfigError
        An unknown name (the nearest known one is suggested), a wrong type or a value out of range.
    """
    config = Config.from_mapping(
        {
            name: override.value
            for name, override in sorted(node._parameter_overrides.items())
            if name not in _OTHERS and not name.startswith("qos_overrides")
        }
    )
    folder = config.output.folder.replace(_NODE, node.get_fully_qualified_name().strip("/").replace("/", "_"))
    config = config.changed({"output.folder": folder})
    used = dict(flatten(config.as_mapping()))
    for p in parameters(one.name for one in config.sources):
        node.declare_parameter(p.name, used[p.name], _descriptor(p), ignore_override=True)
    return config


def files_for_others(arguments: Sequence[str], name: str) -> Iterator[str]:
    """Yield a sentence on each parameter file in the arguments with nothing for a node of that name: ROS ignores it."""
    for option, file in pairwise(arguments):
        if option != "--params-file":
            continue
        try:
            names = list(_sections_of(yaml.safe_load(read_text(Path(file), follow=True))))
        except (OSError, ValueError, yaml.YAMLError):  # rclpy says why it cannot be read
            continue
        if names and not any(fnmatchcase(name, one) for one in names):
            yield f"{file}: nothing in it is for {name}: it has {', '.join(names[:5])}; /** is for any node"


def _sections_of(values: Any, path: str = "") -> Iterator[str]:
    """Names of the nodes, perhaps with wildcards, for which a parameter file has parameters."""
    for key, value in values.items() if isinstance(values, dict) else ():
        inside = f"{path}/{str(key).strip('/')}"
        if isinstance(value, dict) and "ros__parameters" in value:
            yield inside
        else:
            yield from _sections_of(value, inside)


def changed(config: Config, given: Iterable[Any], *, is_configured: bool) -> tuple[Config, dict[str, Any]]:
    """Return the configuration after a change of ROS parameters, and those of them that are ours, in their types.

    Raises
    ------
    ConfigError
        One of them may not be changed now, or not to that: none is.
    """
    values = {one.name: one.value for one in given if one.name not in _OTHERS}
    wanted = config.changed(values)
    live = {p.name for p in parameters(one.name for one in config.sources) if p.live}
    if is_configured and (fixed := sorted(set(values) - live)):
        when = "at the start of the node" if fixed[0] in _AT_START else "before the node is configured"
        raise ConfigError(f"{fixed[0]}: can be changed only {when}")
    used = dict(flatten(wanted.as_mapping()))
    return wanted, {name: used[name] for name in values}


def _descriptor(p: Parameter) -> ParameterDescriptor:
    unit = f" [{p.unit}]" if p.unit else ""
    choices = f" One of: {', '.join(p.choices)}." if p.choices else ""
    when = " May change at any time." if p.live else ""
    fixed = p.name in _AT_START
    descriptor = ParameterDescriptor(description=f"{p.meaning}{unit}.{choices}{when}", read_only=fixed)
    if p.low is None and p.high is None:
        return descriptor
    largest = sys.float_info.max if p.type is float else 2**31 - 1
    low, high = -largest if p.low is None else p.low, largest if p.high is None else p.high
    if p.type is float:
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif p.type is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor

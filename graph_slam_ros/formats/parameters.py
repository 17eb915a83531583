"""Parameter files: YAML as ROS reads it, strictly. One file serves ``ros2 launch`` and ``graph_slam replay``."""

import json
import re
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any

import yaml

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.formats.files import opened

_MAX_BYTES, _MAX_DEPTH, _MAX_NODES = 2**20, 50, 20_000
_PRESETS = Path(__file__).parents[1] / "config/presets"
_NODE, _WRAPPER = "graph_slam", "ros__parameters"
_OF_ANY_NODE = ("use_sim_time", "qos_overrides", "start_type_description_service")  # which rclpy itself reads


class _StrictLoader(yaml.SafeLoader):
    """Refuses what YAML would silently read as something else, and what is made to exhaust its reader.

    A key given twice, of which the last would be kept; numbers and words that YAML 1.1 reads in its own way; aliases,
    which ROS does not read either, and by which a few lines may grow without end.
    """

    _depth = _nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        self._nodes += 1
        if isinstance(event, yaml.AliasEvent):
            raise _fault(event, "aliases are not read")
        if event.tag not in _TAGS:
            raise _fault(event, f"the tag {event.tag} is not read")
        if self._depth == _MAX_DEPTH or self._nodes > _MAX_NODES:
            raise _fault(event, f"more than {_MAX_DEPTH} levels, or than {_MAX_NODES} values")
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                raise _fault(key_node, "a key is not a name")
            if key in seen:
                raise _fault(key_node, f"{key!r} is given twice")
            seen.add(key)
        return super().construct_mapping(node, deep)


def _fault(at: Any, what: str) -> ConfigError:
    return ConfigError(f"line {at.start_mark.line + 1}: {what}")


def _as_everybody(pattern: str, construct: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """A constructor of a number or a truth value that refuses what people read otherwise than YAML 1.1."""

    def constructed(loader: _StrictLoader, node: yaml.ScalarNode) -> Any:
        value = construct(loader, node)
        if not re.fullmatch(pattern, node.value, re.ASCII):
            usual = repr(value).lower() if isinstance(value, bool) else repr(value)
            raise _fault(node, f"{node.value} is {usual} to YAML: write {usual}, or '{node.value}' for a text")
        return value

    return constructed


_TAGS = (None, "tag:yaml.org,2002:str")  # the others have ways of their own to fail
_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
_FLOAT, _INT, _BOOL = (f"tag:yaml.org,2002:{kind}" for kind in ("float", "int", "bool"))
for _tag, _pattern, _construct in (
    (_FLOAT, _NUMBER, yaml.SafeLoader.construct_yaml_float),
    (_INT, r"[-+]?(?:0|[1-9]\d*)|0x[0-9a-fA-F]+", yaml.SafeLoader.construct_yaml_int),
    (_BOOL, "(?i:true|false)", yaml.SafeLoader.construct_yaml_bool),
):
    _StrictLoader.add_constructor(_tag, _as_everybody(_pattern, _construct))
# YAML 1.1 reads 1e-3 as a text; ROS and people read a number
_StrictLoader.add_implicit_resolver(
    _FLOAT, re.compile(r"^[-+]?(?:\d+(?:\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def read_parameters(path: Path | str, *, follow: bool = True) -> dict[str, Any]:
    """Nested values of a parameter file; a ROS wrapper (``/**: ros__parameters: ...``) is taken off.

    What any node has (``use_sim_time``) is left out. Of a file for several nodes, the section of ``graph_slam``.
    ``follow``: a user names the file: it may be a symbolic link, and the name of a preset stands for its file.

    Raises
    ------
    ConfigError
        Naming the file and what is wrong.
    """
    path, presets = Path(path), {file.stem: file for file in _PRESETS.glob("*.yaml")} if follow else {}
    if not path.is_file():
        path = presets.get(str(path), path)
    try:
        with opened(path, follow=follow) as stream:
            content = stream.read(_MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise ConfigError(f"larger than {_MAX_BYTES} bytes")
        values = yaml.load(content.decode("utf-8-sig"), Loader=_StrictLoader)
    except OSError as error:
        known = f"; presets: {', '.join(sorted(presets))}" if presets and not path.suffix else ""
        raise ConfigError(f"{path}: {error.strerror}{known}") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: not UTF-8, or a date like 2001-99-99
        raise ConfigError(f"{path}: not valid YAML ({' '.join(str(error).split())[:200]})") from None
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: not a mapping of parameters")
    return _unwrapped(path, values)


def _unwrapped(path: Path, values: dict[Any, Any]) -> dict[str, Any]:
    wrapped = {k: v for k, v in values.items() if isinstance(v, dict) and _WRAPPER in v}
    if any(isinstance(v, dict) and "ros_parameters" in v for v in values.values()):
        raise ConfigError(f"{path}: ros_parameters: did you mean {_WRAPPER}? It has two underscores")
    if wrapped and len(values) > 1:
        ours = [name for name in wrapped if str(name).rpartition("/")[2] == _NODE]
        if len(ours) != 1 or any("*" in str(name) for name in values):
            raise ConfigError(
                f"{path}: parameters of several nodes ({', '.join(map(str, values))}); give a file of one"
            )
        wrapped = {ours[0]: wrapped[ours[0]]}
    inner = next(iter(wrapped.values()))[_WRAPPER] if wrapped else values
    if not isinstance(inner, dict):
        raise ConfigError(f"{path}: {_WRAPPER} is not a mapping")
    for key in inner:
        if not isinstance(key, str):
            raise ConfigError(f"{path}: {key!r} is not a name")
    return {k: v for k, v in inner.items() if not wrapped or k.partition(".")[0] not in _OF_ANY_NODE}


def assignment(key: str, value: Any) -> str:
    """Return ``KEY=VALUE`` as ``parse_setting`` reads it: a text that looks like a number stays one."""
    text = f"{key}={value}"
    return text if parse_setting(text) == (key, value) else f"{key}={json.dumps(value)}"


def parse_setting(text: str) -> tuple[str, Any]:
    """``key=value`` of a command line, the value read as YAML reads it."""
    key, separator, value = text.partition("=")
    if not separator or not key:
        raise ConfigError(f"{text!r} is not key=value")
    try:
        return key, yaml.load(value, Loader=_StrictLoader)
    except ConfigError as error:
        raise ConfigError(f"{key}: {str(error).removeprefix('line 1: ')}") from None
    except (yaml.YAMLError, ValueError, RecursionError):
        raise ConfigError(f"{key}: {value!r} is not a valid value") from None


def parameters_text(values: Mapping[str, Mapping[str, Any]], notes: Mapping[str, str] | None = None) -> str:
    """A parameter file with every value, and a comment above each that has a note (by ``section.key``)."""
    lines = ["/**:", "  ros__parameters:"]
    for section, members in values.items():
        lines.append(f"    {section}:")
        for key, value in members.items():
            if note := (notes or {}).get(f"{section}.{key}"):
                lines.append(f"      # {note}")
            lines.append(f"      {key}: {_scalar(value)}")
    return "\n".join(lines) + "\n"


def _scalar(value: Any) -> str:
    if isinstance(value, float):  # YAML 1.1 reads 1e-05 as a text
        text = repr(value)
        return text if "." in text or "e" not in text else text.replace("e", ".0e")
    return json.dumps(value, ensure_ascii=False)

"""Classes of messages by the name of their type, for those packages that are installed."""

import importlib
from typing import Any

from graph_slam_ros.errors import ConfigError


def message_class(type_name: str) -> Any:
    """The Python class of a type ``package/msg/Name``.

    Raises
    ------
    ConfigError
        The package is not installed, or has no such message.
    """
    package, _, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise ConfigError(f"{type_name}: {package} is not installed here, or has no such message") from None

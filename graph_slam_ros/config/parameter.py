"""The description of a parameter, and the declaration of a section of parameters."""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from graph_slam_ros.errors import ConfigError, did_you_mean


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter. ``low`` and ``high`` are inclusive; ``live``: it may change at run time."""

    name: str
    type: type
    default: Any
    meaning: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    live: bool = False

    def check(self, value: Any) -> Any:
        """The value in its type. Raises ConfigError naming parameter, value and what is allowed."""
        if self.type is float and type(value) is int and abs(value) < 2**1000:
            value = float(value)
        if type(value) is not self.type:
            raise ConfigError(f"{self.name}: {value!r} is not {_ARTICLE[self.type]}")
        if self.choices and value not in self.choices:
            near = did_you_mean(value, self.choices) if isinstance(value, str) else ""
            raise ConfigError(f"{self.name}: {value!r} is not one of {', '.join(self.choices)}{near}")
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            if isinstance(value, float) and not math.isfinite(value):
                raise ConfigError(f"{self.name}: {value!r} is not finite")
            if (self.low is not None and value < self.low) or (self.high is not None and value > self.high):
                raise ConfigError(f"{self.name}: {value!r} is not in {self.range_text()}")
        return value

    def range_text(self) -> str:
        """The allowed interval in words."""
        low = "-inf" if self.low is None else f"{self.low:g}"
        return f"[{low}, {'inf' if self.high is None else f'{self.high:g}'}]"


_LARGEST = 1e9  # its square, and as many seconds in nanoseconds, can be reckoned with
_ARTICLE = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}


def setting(
    default: Any,
    meaning: str,
    unit: str = "",
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """Declare a field of a section. A number is not negative, unless ``low`` says so."""
    if isinstance(default, float):
        low, high = 0.0 if low is None else low, _LARGEST if high is None else high
    return field(default=default, metadata={"about": (meaning, unit, low, high, choices, live)})


def numbers(name: str, text: str, *counts: int) -> tuple[float, ...]:
    """Numbers of a parameter's text; none if it is empty. Raises ConfigError if their number is another."""
    try:
        found = tuple(map(float, text.split()))
    except ValueError:
        found = (math.nan,)
    if len(found) not in (0, *counts) or not all(map(math.isfinite, found)):
        raise ConfigError(f"{name}: {text!r} is not {' or '.join(map(str, counts))} numbers")
    return found


def section_parameters(section: str, members: Any) -> Iterator[Parameter]:
    """The parameters of a section; ``members`` are its defaults."""
    for key in dataclasses.fields(members):
        if "about" in key.metadata:
            meaning, unit, *limits = key.metadata["about"]
            default = getattr(members, key.name)
            yield Parameter(f"{section}.{key.name}", type(default), default, meaning, unit, *limits)

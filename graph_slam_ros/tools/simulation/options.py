"""Options of worlds and faults: parameters of a function, each with default, unit, meaning and bounds.

A function with options is called with some of them; ``checked`` fills in the others.
"""

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from inspect import signature
from typing import Any

from numpy.random import PCG64, Generator, SeedSequence

from graph_slam_ros.errors import GraphSlamError, did_you_mean

_ARTICLE = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}


@dataclass(frozen=True, slots=True)
class Option:
    """An option; ``low`` and ``high`` are inclusive, ``choices`` those of a text."""

    default: Any
    meaning: str
    unit: str = ""
    low: float = 0.0
    high: float = 1e6
    choices: tuple[str, ...] = ()

    def check(self, what: str, value: Any) -> Any:
        """The value in the option's type. Raises GraphSlamError with ``what`` and what is allowed."""
        kind = type(self.default)
        if kind is float and type(value) is int and abs(value) < 2**1000:
            value = float(value)
        if type(value) is not kind:
            raise GraphSlamError(f"{what}: {value!r} is not {_ARTICLE[kind]}")
        if kind is str:
            if value not in self.choices:
                near = did_you_mean(value, self.choices)
                raise GraphSlamError(f"{what}: {value!r} is not one of {', '.join(self.choices)}{near}")
        elif kind is not bool and not (self.low <= value <= self.high and value != math.inf):
            raise GraphSlamError(f"{what}: {value!r} is not in [{self.low:g}, {self.high:g}]")
        return value


def option(*of: Any, **more: Any) -> Any:
    """An option, as the default of a parameter; what it is made of as of ``Option``."""
    return Option(*of, **more)


def options_of(what: Callable[..., Any]) -> dict[str, Option]:
    """Every option of a function by its name, in order."""
    found = {name: parameter.default for name, parameter in signature(what).parameters.items()}
    return {name: default for name, default in found.items() if isinstance(default, Option)}


def checked(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Let a function be called with some of its options, which are checked, under a name."""

    def with_name(function: Callable[..., Any]) -> Callable[..., Any]:
        known = options_of(function)
        others = signature(function).parameters.keys() - known.keys()

        @functools.wraps(function)
        def call(*given: Any, **values: Any) -> Any:
            named = {key: values.pop(key) for key in others & values.keys()}
            return function(*given, **named, **filled(name, known, values))

        return call

    return with_name


def filled(name: str, known: Mapping[str, Option], values: Mapping[str, Any]) -> dict[str, Any]:
    """All options of a world or fault: the named values; the rest have their defaults.

    Raises GraphSlamError: unknown option (those that exist are named), wrong type, or a value out of bounds.
    """
    for one in values:
        if one not in known:
            near = did_you_mean(one, known)
            raise GraphSlamError(f"{name}: no option {one!r}; it has {', '.join(known)}{near}")
    return {k: o.check(f"{name}: {k}", values[k]) if k in values else o.default for k, o in known.items()}


def lines_about(name: str, what: Callable[..., Any]) -> Iterator[str]:
    """Describe a world or a fault, and its options."""
    yield f"  {name}: {about(what)}"
    for key, o in options_of(what).items():
        choices = f": {', '.join(o.choices)}" if o.choices else ""
        default = str(o.default).lower() if isinstance(o.default, bool) else o.default
        yield f"    {key}={default}{f' [{o.unit}]' if o.unit else ''}  {o.meaning}{choices}"


def about(what: Callable[..., Any]) -> str:
    """Describe a world or a fault in one sentence."""
    return (what.__doc__ or "").strip().splitlines()[0]


def random(seed: int, *stream: int) -> Generator:
    """The random numbers of a seed, or of a stream of it. Raises GraphSlamError for a seed that nothing takes."""
    if seed < 0:
        raise GraphSlamError(f"seed {seed} is negative")
    return Generator(PCG64(SeedSequence(seed, spawn_key=stream)))

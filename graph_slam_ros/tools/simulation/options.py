"""Options of worlds and faults: parameters of a function, each with default, unit, meaning and bounds.

A function with options is called with some of them; ``checked`` fills in the others.
"""

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from inspect import signature
from typing import Any

from numpy.random import PCG64, Generator, SeedSequence

from graph_slam_ros.config.parameter import Parameter
from graph_slam_ros.errors import GraphSlamError, did_you_mean


def option(
    default: Any, meaning: str, unit: str = "", low: float = 0.0, high: float = 1e6, choices: tuple[str, ...] = ()
) -> Any:
    """An option, as the default of a parameter of a function."""
    return Parameter("", type(default), default, meaning, unit, low, high, choices)


def options_of(what: Callable[..., Any]) -> dict[str, Parameter]:
    """Every option of a function by its name, in order."""
    found = {name: parameter.default for name, parameter in signature(what).parameters.items()}
    return {name: default for name, default in found.items() if isinstance(default, Parameter)}


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


def filled(name: str, known: Mapping[str, Parameter], values: Mapping[str, Any]) -> dict[str, Any]:
    """All options of a world or fault: the named values; the rest have their defaults.

    Raises GraphSlamError: unknown option (those that exist are named), wrong type, or a value out of bounds.
    """
    for one in values:
        if one not in known:
            near = did_you_mean(one, known)
            raise GraphSlamError(f"{name}: no option {one!r}; it has {', '.join(known)}{near}")
    named = {key: replace(one, name=f"{name}: {key}") for key, one in known.items()}
    return {key: one.check(values.get(key, one.default)) for key, one in named.items()}


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

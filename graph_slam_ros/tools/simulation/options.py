"""Options of worlds and faults, with unit, meaning and bounds: fields of a dataclass, or parameters of a function."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import signature
from typing import Any

from graph_slam_ros.errors import GraphSlamError, did_you_mean


@dataclass(frozen=True, slots=True)
class Option:
    """An option; ``low`` and ``high`` are inclusive, ``choices`` those of a text."""

    name: str
    default: Any
    meaning: str
    unit: str
    low: float
    high: float
    choices: tuple[str, ...]

    def check(self, world: str, value: Any) -> Any:
        """The value in the option's type. Raises GraphSlamError naming world, option and what is allowed."""
        kind = type(self.default)
        if kind is float and type(value) is int and abs(value) < 2**1000:
            value = float(value)
        if type(value) is not kind:
            raise GraphSlamError(f"{world}: {self.name}: {value!r} is not {_ARTICLE[kind]}")
        if kind is str:
            if value not in self.choices:
                raise GraphSlamError(
                    f"{world}: {self.name}: {value!r} is not one of {', '.join(self.choices)}"
                    f"{did_you_mean(value, self.choices)}"
                )
        elif kind is not bool and not (self.low <= value <= self.high and value != math.inf):
            raise GraphSlamError(f"{world}: {self.name}: {value!r} is not in [{self.low:g}, {self.high:g}]")
        return value


_ARTICLE = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}


def option(
    default: Any, meaning: str, unit: str = "", low: float = 0.0, high: float = 1e6, choices: tuple[str, ...] = ()
) -> Any:
    """An option, as a field of a dataclass or as the default of a parameter."""
    return field(default=default, metadata={"about": (meaning, unit, low, high, choices)})


class Kinds(dict[str, Callable[..., None]]):
    """Kinds of faults by name: functions that take a ``Draft`` or a ``Drive``, random numbers, and options."""

    def add(self, put: Callable[..., None]) -> Callable[..., None]:
        """Add a function under its name."""
        self[put.__name__] = put
        return put


@dataclass(frozen=True, slots=True)
class World:
    """A world: the dataclass of its options, and the function that drives through it, or that measures its graph."""

    options: type
    make: Callable[..., Any]


def about(what: Callable[..., Any]) -> str:
    """Describe a world or a fault in one sentence."""
    return (what.__doc__ or "").strip().splitlines()[0]


def check_seed(seed: int) -> None:
    """Raise GraphSlamError for a seed that no random generator takes."""
    if seed < 0:
        raise GraphSlamError(f"seed {seed} is negative")


def options_of(what: type | Callable[..., Any]) -> Iterator[Option]:
    """Every option of a world's dataclass or of a fault, in order."""
    parameters = signature(what).parameters
    fields = {name: p.default for name, p in parameters.items() if isinstance(p.default, dataclasses.Field)}
    for name, f in ({f.name: f for f in dataclasses.fields(what)} if isinstance(what, type) else fields).items():
        yield Option(name, f.default, *f.metadata["about"])


def filled(
    name_of: str, what: type | Callable[..., Any], values: Mapping[str, Any], others: Sequence[str] = ()
) -> dict[str, Any]:
    """All options: the named values; the rest have their defaults.

    Parameters
    ----------
    others : names of options that are elsewhere, to be named beside these

    Raises
    ------
    GraphSlamError
        Unknown name, wrong type, or a value out of bounds.
    """
    known = {o.name: o for o in options_of(what)}
    for name in values:
        if name not in known:
            there = [*known, *others]
            raise GraphSlamError(f"{name_of}: no option {name!r}; it has {', '.join(there)}{did_you_mean(name, there)}")
    return {name: o.check(name_of, values[name]) if name in values else o.default for name, o in known.items()}

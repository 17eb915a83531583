"""Options of a world: a frozen dataclass whose fields carry unit, meaning and bounds, filled from names and values."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from numpy.random import Generator

from graph_slam_ros.errors import GraphSlamError, did_you_mean

Options = TypeVar("Options")


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


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault: its dataclass of options, and the function that puts it into a ``Draft`` or a ``Drive``."""

    options: type
    put: Callable[[Any, Any, Generator], None]

    @property
    def about(self) -> str:
        """One sentence on it."""
        return (self.options.__doc__ or "").strip().splitlines()[0]


_ARTICLE = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}


def option(
    default: Any, meaning: str, unit: str = "", low: float = 0.0, high: float = 1e6, choices: tuple[str, ...] = ()
) -> Any:
    """Dataclass field of an option."""
    return field(default=default, metadata={"about": (meaning, unit, low, high, choices)})


def check_seed(seed: int) -> None:
    """Raise GraphSlamError for a seed that no random generator takes."""
    if seed < 0:
        raise GraphSlamError(f"seed {seed} is negative")


def options_of(cls: type) -> Iterator[Option]:
    """Every option of a world's dataclass, in order."""
    for f in dataclasses.fields(cls):
        yield Option(f.name, f.default, *f.metadata["about"])


def fill(world: str, cls: type[Options], values: Mapping[str, Any], others: Sequence[str] = ()) -> Options:
    """The dataclass with the named values; the rest keep their defaults.

    Parameters
    ----------
    others : names of options that are elsewhere, to be named beside those of the dataclass

    Raises
    ------
    GraphSlamError
        Unknown name, wrong type, or a value out of bounds.
    """
    known = {o.name: o for o in options_of(cls)}
    for name in values:
        if name not in known:
            there = [*known, *others]
            raise GraphSlamError(f"{world}: no option {name!r}; it has {', '.join(there)}{did_you_mean(name, there)}")
    return cls(**{name: known[name].check(world, value) for name, value in values.items()})

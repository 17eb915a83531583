"""Usage errors and help of the command line."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NoReturn

from graph_slam_ros.cli import console
from graph_slam_ros.errors import did_you_mean

CODES = "Exit codes: 0 done, 1 internal error, 2 refused, 3 done but something was lost, 130 interrupted."


class _Formatter(argparse.HelpFormatter):
    """Wraps paragraphs. Lines that begin with a space stay as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        fill = super()._fill_text
        return "\n".join(line if line.startswith(" ") else fill(line, width, indent) for line in text.splitlines())


class CommandParser(argparse.ArgumentParser):
    """Reports usage errors in one line. Its help ends with examples and the exit codes."""

    more: Callable[[], str] | None = None  # what the help tells besides, where it takes imports to know it
    elsewhere: Mapping[str, str] = MappingProxyType({})  # words that are no commands, and what does the same
    codes = CODES

    def __init__(self, *args: Any, examples: Sequence[str] = (), **options: Any) -> None:
        super().__init__(*args, **options)
        self.formatter_class = _Formatter
        self.examples = examples

    def format_help(self) -> str:
        """The help."""
        shown = [f"Example{'s' * (len(self.examples) > 1)}:", *(f"  {line}" for line in self.examples)]
        self.epilog = "\n".join([self.more(), ""] if self.more else []) + "\n".join([*shown, self.codes])
        return super().format_help()

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse what is none of the choices of an argument, with the choice that is close."""
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            other = self.elsewhere.get(str(value))
            near = f"; {self.prog} {other}" if other else did_you_mean(str(value), map(str, action.choices or ()))
            raise argparse.ArgumentError(action, f"{error.message}{near}") from None

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Refuse options that the command does not have, with the option that is close, and a second recording."""
        known, rest = super().parse_known_args(args, namespace)
        if options := [word.partition("=")[0] for word in rest if word.startswith("--")]:
            near = did_you_mean(options[0], self._option_string_actions)
            self.error(f"unrecognized arguments: {' '.join(rest)}{near}")
        if rest and (bare := [one for one in getattr(known, "set", None) or () if "=" not in one]):
            self.error(f"--set {bare[0]}: a setting is KEY=VALUE, no spaces around =; quote a value with spaces")
        if rest and hasattr(known, "bag"):
            self.error(f"{rest[0]} is one recording too many: put the parts of one drive into a folder, and name that")
        return known, rest

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        console.warn(f"{message} (--help shows what there is)", self.prog)
        self.exit(console.REFUSED)

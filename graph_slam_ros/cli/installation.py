"""The commands on what is installed: ``params``, ``warmup``, ``completion``.

The script of ``completion`` is made from the parser, and does not start Python while the user types.
"""

import argparse
import fnmatch
import shlex
from collections.abc import Iterator

from graph_slam_ros.cli import console
from graph_slam_ros.cli.arguments import CommandParser
from graph_slam_ros.config.config import parameters
from graph_slam_ros.config.parameter import Parameter
from graph_slam_ros.errors import GraphSlamError

_SCRIPT = """\
_graph_slam() {
  local cur=${COMP_WORDS[COMP_CWORD]} prev=${COMP_WORDS[COMP_CWORD-1]} command=${COMP_WORDS[1]} list=
  if [ "$COMP_CWORD" -eq 1 ]; then
    list=%(commands)s
  else
    if [ "$COMP_CWORD" -gt 2 ]; then
      case "$command" in %(groups)s) command="$command ${COMP_WORDS[2]}" ;; esac
    fi
    case "$command $prev" in
%(choices)s
    *)
      case "$command" in
%(options)s
      esac
      case "$cur" in -*) ;; *) list=${list##*@} ;; esac ;;
    esac
  fi
  COMPREPLY=($(compgen -W "${list//@/ }" -- "$cur"))
}
complete -o bashdefault -o default -F _graph_slam graph_slam
"""
_ZSH = "autoload -U +X compinit && compinit -u\nautoload -U +X bashcompinit && bashcompinit\n"


def params_options(sub: CommandParser) -> None:
    """Add the options of ``params``."""
    about = "part of a name or of its help, or a name with * (default: all)"
    sub.add_argument("pattern", nargs="?", default="", metavar="PATTERN", help=about)


def params(args: argparse.Namespace) -> int:
    """List the parameters whose name or meaning matches a pattern."""
    found = [p for p in parameters() if _matches(p, args.pattern)]
    if not found:
        raise GraphSlamError(f"no parameter matches {args.pattern!r} (without a pattern all are listed)")
    for p in found:
        console.show(*_lines(p))
    console.then(f"set one with --set {found[0].name}={_word(found[0].default)}, or in a parameter file (--config)")
    return console.DONE


def _matches(p: Parameter, pattern: str) -> bool:
    """Match by the name, with * and ?; a plain word also matches within the name or the meaning."""
    word = pattern.lower()
    return fnmatch.fnmatchcase(p.name, word) or word in p.name or word in p.meaning.lower()


def _lines(p: Parameter) -> Iterator[str]:
    unit = f" {p.unit}" if p.unit else ""
    in_range = f"in {p.range_text()}" if p.low is not None or p.high is not None else ""
    limits = f"one of {', '.join(p.choices)}" if p.choices else in_range
    when = "may change at any time" if p.live else "read at the start"
    yield f"{p.name} = {_word(p.default)}{unit}   ({'; '.join(filter(None, (limits, when)))})"
    yield f"    {p.meaning}"


def _word(default: object) -> str:
    if isinstance(default, bool):
        return str(default).lower()
    return f"{default:g}" if isinstance(default, float) else str(default) or '""'


def warmup_options(sub: CommandParser) -> None:
    """Add the options of ``warmup``."""
    sub.add_argument("--dimensions", type=int, choices=(2, 3), default=3, help="2: the plane alone (default: 3)")


def warmup(args: argparse.Namespace) -> int:
    """Compile the kernels."""
    from graph_slam_ros.warmup import warmup as compiled

    console.warn(f"kernels ready after {compiled(dimensions=args.dimensions):.1f} s")
    console.then(console.command("info", "RECORDING"))
    return console.DONE


def completion_options(sub: CommandParser) -> None:
    """Add the options of ``completion``."""
    sub.add_argument("shell", choices=("bash", "zsh"), help='shell; use: eval "$(graph_slam completion bash)"')


def completion(args: argparse.Namespace) -> int:
    """Print the script."""
    from graph_slam_ros.cli.parser import parser

    console.show(*((_ZSH if args.shell == "zsh" else "") + script(parser())).splitlines())
    return console.DONE


def script(whole: argparse.ArgumentParser) -> str:
    """The script for bash, which zsh can run, too."""
    names = [*_commands(whole), *(option for a in whole._actions for option in a.option_strings)]
    groups = [name for name, sub in _commands(whole).items() if _commands(sub)]
    choices, options = [], []
    for name, sub in _all(whole):
        choices += [f"    {name}\\ {option}) list={_quoted(values)} ;;" for option, values in _choices(sub)]
        of_command = [option for action in sub._actions for option in action.option_strings]
        places = [str(c) for a in sub._actions if not a.option_strings for c in a.choices or ()]
        options.append(f"      {name}) list={_quoted(of_command)}@{_quoted(places)} ;;")
    lines = {"choices": "\n".join(choices), "options": "\n".join(options)}
    return _SCRIPT % {**lines, "commands": _quoted(names), "groups": "|".join(groups)}


def _commands(of: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    return {k: sub for a in of._actions if isinstance(a, argparse._SubParsersAction) for k, sub in a.choices.items()}


def _all(whole: argparse.ArgumentParser, before: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield each command, as the shell quotes it, and those of groups."""
    for name, sub in _commands(whole).items():
        yield f"{before}{name}", sub
        yield from _all(sub, f"{before}{name}\\ ")


def _choices(sub: argparse.ArgumentParser) -> Iterator[tuple[str, list[str]]]:
    for action in sub._actions:
        if action.choices:
            for option in action.option_strings:
                yield option, [str(choice) for choice in action.choices]


def _quoted(words: list[str]) -> str:
    return shlex.quote(" ".join(words))

"""Argument parser of the commands: help with examples, suggestions for misspelt options and choices."""

from __future__ import annotations

import argparse
import re
from math import inf
from pathlib import Path
from typing import Any, NoReturn

from icalib.base.yaml_nodes import suggestion

_CHOICES = re.compile(r"invalid choice: (?P<given>'[^']*'|\S+) \(choose from (?P<choices>.*)\)", re.DOTALL)


def examples(*lines: str) -> str:
    """Section with example command lines, for the end of the help of a command."""
    return "\n".join(("examples:", *(f"  {line}" for line in lines)))


def add_command(
    commands: argparse._SubParsersAction[CommandParser], name: str, about: str, *lines: str, codes: str = ""
) -> CommandParser:
    """Adds and returns the parser of a command. about: short help. lines: examples. codes: help on exit codes."""
    description = f"{about[:1].upper()}{about[1:]}." + (f"\n{codes}" if codes else "")
    return commands.add_parser(name, help=about, description=description, epilog=examples(*lines))


def add_part(parser: argparse.ArgumentParser) -> None:
    """Adds the options --from and --to: used part of a recording, in seconds from its start."""
    start = "use the recording from here on, in seconds from its start; default: 0"
    parser.add_argument("--from", type=float, default=0.0, metavar="SECONDS", dest="start_s", help=start)
    parser.add_argument(
        "--to", type=float, default=inf, metavar="SECONDS", dest="end_s", help="use it up to here; default: its end"
    )


class CommandParser(argparse.ArgumentParser):
    """Parser that keeps line breaks of examples, and suggests the nearest option or choice for a misspelt one. Parsers
    of commands have the same class."""

    def __init__(self, **fields: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **fields)
        self._arguments: list[str] = []

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """As the base class, but stores the arguments for `error`, and refuses unknown ones at once, so that the parser
        of the command reports them."""
        if args is not None:
            self._arguments = list(args)
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return parsed, unknown

    def error(self, message: str) -> NoReturn:
        """Prints usage and an error message, and exits with code 2."""
        if match := _CHOICES.search(message):
            value, available = match["given"].strip("'"), tuple(re.findall(r"[\w./^-]+", match["choices"]))
            where = f"{message[: match.start()]}there is no {value!r}{suggestion(value, available)}"
            message = f"{where}; available are {', '.join(available)}."
        elif wrong := self._wrong_option():
            message = f"there is no option {wrong}{suggestion(wrong, self._options())}; --help lists all."
        super().error(message)

    def _options(self) -> tuple[str, ...]:
        return tuple(o for action in self._actions for o in action.option_strings if o.startswith("--"))

    def _wrong_option(self) -> str:
        """The first given option that does not exist; empty if all do. Abbreviations of options are valid."""
        options = (o.partition("=")[0] for o in self._arguments if o.startswith("--") and len(o) > 2)
        return next((o for o in options if not any(known.startswith(o) for known in self._options())), "")


def file_path(text: str) -> Path:
    """`type` of an option with a path. Raises ArgumentTypeError for an empty one, as of an unset variable of a shell,
    which would be the current folder."""
    if not text.strip() or "\0" in text:
        raise argparse.ArgumentTypeError(f"must be a path, but is {text!r}")
    return Path(text)


def nonnegative_int(text: str) -> int:
    """`type` of an option with a non-negative integer. Raises ArgumentTypeError."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number, but is {text!r}")
    return int(text)


def count(text: str) -> int:
    """`type` of an option with an integer of at least 1. Raises ArgumentTypeError."""
    if nonnegative_int(text) == 0:
        raise argparse.ArgumentTypeError("must be at least 1, but is 0")
    return int(text)


def address(text: str) -> tuple[str, int]:
    """`type` of an option with an address, PORT or HOST:PORT. Raises ArgumentTypeError."""
    host, _, port = text.rpartition(":")
    if not (port.isdecimal() and int(port) < 65536):
        raise argparse.ArgumentTypeError(f"must be PORT or HOST:PORT, as in 8765, but is {text!r}")
    return host or "127.0.0.1", int(port)

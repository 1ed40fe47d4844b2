"""The parser of the commands: help with examples, and the nearest name where an option or a choice does not exist."""

from __future__ import annotations

import argparse
import re
from math import inf
from typing import Any, NoReturn

from icalib.base.suggestion import suggestion

_CHOICES = re.compile(r"invalid choice: (?P<given>'[^']*'|\S+) \(choose from (?P<choices>.*)\)", re.DOTALL)


def examples(*lines: str) -> str:
    """The end of a command's help."""
    return "\n".join(("examples:", *(f"  {line}" for line in lines)))


def add_command(
    commands: argparse._SubParsersAction[CommandParser], name: str, about: str, *lines: str, codes: str = ""
) -> CommandParser:
    """The parser of a command. about: its short help; lines: its examples; codes: a line on its exit codes."""
    description = f"{about[:1].upper()}{about[1:]}." + (f"\n{codes}" if codes else "")
    return commands.add_parser(name, help=about, description=description, epilog=examples(*lines))


def add_part(parser: argparse.ArgumentParser) -> None:
    """Which part of a recording is used."""
    start = "use the recording from here on, in seconds from its start; default: 0"
    parser.add_argument("--from", type=float, default=0.0, metavar="SECONDS", dest="start_s", help=start)
    parser.add_argument(
        "--to", type=float, default=inf, metavar="SECONDS", dest="end_s", help="use it up to here; default: its end"
    )


class CommandParser(argparse.ArgumentParser):
    """Keeps the line breaks of examples, and names the nearest option or choice where one does not exist. The parsers
    of its commands are of this class."""

    def __init__(self, **fields: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **fields)
        self._given: list[str] = []

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """As the base class, but keeps the arguments for `error`, and leaves none to the parser above."""
        if args is not None:
            self._given = list(args)
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown

    def error(self, message: str) -> NoReturn:
        """Prints usage and one sentence, and leaves with exit code 2."""
        if found := _CHOICES.search(message):
            given, available = found["given"].strip("'"), tuple(re.findall(r"[\w./^-]+", found["choices"]))
            where = f"{message[: found.start()]}there is no {given!r}{suggestion(given, available)}"
            message = f"{where}; available are {', '.join(available)}."
        elif wrong := self._wrong_option():
            message = f"there is no option {wrong}{suggestion(wrong, self._options())}; --help lists all."
        super().error(message)

    def _options(self) -> tuple[str, ...]:
        return tuple(o for action in self._actions for o in action.option_strings if o.startswith("--"))

    def _wrong_option(self) -> str:
        """The first option that was given and does not exist; empty where there is none. Beginnings of options do."""
        options = (o.partition("=")[0] for o in self._given if o.startswith("--") and len(o) > 2)
        return next((o for o in options if not any(known.startswith(o) for known in self._options())), "")


def whole(text: str) -> int:
    """`type` of an option."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number, but is {text!r}")
    return int(text)


def count(text: str) -> int:
    """`type` of an option, at least 1."""
    if whole(text) == 0:
        raise argparse.ArgumentTypeError("must be at least 1, but is 0")
    return int(text)

"""The command `icalib target`: writes a calibration target as PDF for printing."""

from __future__ import annotations

import argparse
from typing import Any

from icalib.cli.command_parser import CommandParser, add_command, count, examples, file_path, nonnegative_int

_MOST_IDS = 10_000  # limit; more than any tag family has
_EXAMPLES = {
    "aprilgrid": "icalib target aprilgrid --rows 6 --cols 6 --tag-size 0.025 --tag-spacing 0.3 --output grid.pdf",
    "charuco": "icalib target charuco --squares-x 7 --squares-y 5 --square-size 0.035 --marker-size 0.026 "
    "--dictionary 5x5_100 -o board.pdf",
    "checkerboard": "icalib target checkerboard --rows 6 --cols 7 --square-size 0.025 -o board.pdf",
    "circles": "icalib target circles --rows 4 --cols 11 --spacing 0.02 --diameter 0.015 --asymmetric -o circles.pdf",
    "markers": "icalib target markers --family tag36h11 --size 0.16 --ids 0-11 -o tags.pdf",
    "tag": "icalib target tag --family tag36h11 --id 3 --size 0.16 -o tag.pdf",
}
_FIELDS = {
    "rows": "number of rows (of a checkerboard: of inner corners)",
    "cols": "number of columns (likewise)",
    "tag_size": "edge of a tag",
    "tag_spacing": "gap between tags over tag_size",
    "squares_x": "squares in a row",
    "squares_y": "squares in a column",
    "square_size": "edge of a square",
    "marker_size": "edge of a tag",
    "dictionary": "family of the tags, as 5x5_100",
    "spacing": "distance of centres",
    "diameter": "of a circle",
    "family": "family of the tags, as tag36h11",
    "size": "edge of the black border of a tag",
    "ids": "ids to print",
    "id": "id to print",
}


def add_target_command(commands: argparse._SubParsersAction[CommandParser]) -> None:
    """Adds the parser of `icalib target TYPE`, whose options are the fields of a target in the rig file."""
    about = "write a target as PDF, to print at true scale"
    t = add_command(commands, "target", about, _EXAMPLES["aprilgrid"], "icalib target aprilgrid --help")
    types = t.add_subparsers(required=True, metavar="TYPE", dest="type")
    for name, options in _options().items():
        _add_type(types, name, options)


def _options() -> dict[str, dict[str, Any]]:
    """Fields of each type of target, with the function that parses the text of each field."""
    return {
        "aprilgrid": {"rows": count, "cols": count, "tag_size": _metres, "tag_spacing": _metres},
        "charuco": {
            "squares_x": count,
            "squares_y": count,
            "square_size": _metres,
            "marker_size": _metres,
            "dictionary": str,
        },
        "checkerboard": {"rows": count, "cols": count, "square_size": _metres},
        "circles": {"rows": count, "cols": count, "spacing": _metres, "diameter": _metres},
        "markers": {"family": str, "size": _metres, "ids": _ids},
        "tag": {"family": str, "id": nonnegative_int, "size": _metres},
    }


def _add_type(types: argparse._SubParsersAction[CommandParser], name: str, options: dict[str, Any]) -> None:
    from icalib.tools.printing import PAPERS

    one = types.add_parser(name, help=f"{name}, with the fields of the rig file", epilog=examples(_EXAMPLES[name]))
    for field, kind in options.items():
        unit = {_metres: "METRES", count: "N", nonnegative_int: "N", _ids: "0-11 or 0,3,7"}.get(kind, "NAME")
        one.add_argument(
            f"--{field.replace('_', '-')}",
            type=kind,
            required=True,
            metavar="RATIO" if field == "tag_spacing" else unit,
            help=_FIELDS[field],
        )
    if name == "circles":
        one.add_argument("--asymmetric", action="store_true", help="shift every other row by one spacing")
        options = options | {"asymmetric": bool}
    elif name != "checkerboard":
        one.add_argument("--border-bits", type=count, metavar="N", help="width of the tags' black border, 1 or 2")
    one.add_argument("--paper", choices=tuple(PAPERS), default="a4", help="size of the paper; default: a4")
    one.add_argument("--output", "-o", type=file_path, required=True, metavar="FILE.pdf", help="file to write")
    one.set_defaults(run=_print_target, fields=tuple(options))


def _ids(text: str) -> tuple[int, ...]:
    """Parses tag ids and ranges of ids, such as 0-11,20. Raises ArgumentTypeError."""
    ids: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        ids += range(nonnegative_int(first), nonnegative_int(last or first) + 1)
    if not ids or len(ids) > _MOST_IDS:
        raise argparse.ArgumentTypeError(f"must be 1 to {_MOST_IDS} ids, as in 0-11 or 0,3,7, but is {text!r}")
    return tuple(ids)


def _metres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a number above 0, but is {text!r}")
    return value


def _print_target(options: argparse.Namespace) -> None:
    from icalib.geometry.targets import TARGETS
    from icalib.tools.printing import write_target

    target = TARGETS[options.type](**{field: getattr(options, field) for field in options.fields})
    write_target(options.output, target, options.paper, getattr(options, "border_bits", None))
    print(f"{options.output}: print at 100 %, and measure the ruler.")

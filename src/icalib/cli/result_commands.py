"""The commands `allan`, `check`, `rig`, `export`, `compare` and `view`."""

from __future__ import annotations

import argparse
from typing import Any, get_args

from icalib.cli.command_parser import CommandParser, add_command, add_part, count, examples, file_path, nonnegative_int
from icalib.rig import AccelUnit, GyroUnit


def add_result_commands(commands: argparse._SubParsersAction[CommandParser]) -> None:
    """Adds the parsers of these commands to `commands`."""
    _add_allan(commands)
    _add_check(commands)
    _add_rig(commands)
    _add_export(commands)
    _add_compare(commands)
    _add_view(commands)


def _add_allan(commands: argparse._SubParsersAction[CommandParser]) -> None:
    about = "estimate noise densities and bias walks of an IMU from a recording at rest"
    c = add_command(
        commands,
        "allan",
        about,
        "icalib allan rest.bag --output noise",
        "icalib allan rest.bag --imu /imu/data -o noise",
    )
    c.add_argument("recording", type=file_path, help="bag or folder of the recording: hours of an IMU at rest")
    c.add_argument("--imu", metavar="TOPIC", help="topic or table of the IMU; default: the only one")
    c.add_argument("--gyro-unit", choices=get_args(GyroUnit), help="unit of its angular rates; default: rad/s")
    accel = "unit of its accelerations; default: m/s^2, or g if gravity shows it"
    c.add_argument("--accel-unit", choices=get_args(AccelUnit), help=accel)
    c.add_argument(
        "--output", "-o", type=file_path, required=True, help="folder for plot, figures and the fields of the rig file"
    )
    c.add_argument("--quiet", "-q", action="store_true", help="print no table")
    c.set_defaults(run=_allan)


def _allan(options: argparse.Namespace) -> None:
    from icalib.tools.allan import study_recording, write_study
    from icalib.tools.allan.files import check_folder, print_study

    check_folder(options.output)
    study = study_recording(options.recording, options.imu, options.gyro_unit, options.accel_unit)
    write_study(study, options.output)
    if not options.quiet:
        print_study(study)
        print(f"Wrote {options.output / 'allan.html'}, allan.json and noise.yaml.")


def _add_export(commands: argparse._SubParsersAction[CommandParser]) -> None:
    from icalib.export.formats import FORMATS, FRAMED, ONE_FILE

    about = "write a result as files of other programs"
    c = add_command(
        commands,
        "export",
        about,
        "icalib export result --to kalibr --output kalibr",
        "icalib export result --to urdf --urdf robot.urdf -o robot.urdf --frame cam0=camera_link",
    )
    c.add_argument("result", type=file_path, help="folder that a calibration was written to")
    c.add_argument("--to", required=True, choices=FORMATS, help="format of the files")
    where = f"folder for the files; for {', '.join(ONE_FILE)} the file itself"
    c.add_argument("--output", "-o", type=file_path, required=True, metavar="PATH", help=where)
    c.add_argument(
        "--urdf", type=file_path, metavar="FILE", help="existing URDF, of which to set the origins of joints"
    )
    frame = f"name of a sensor's frame or link, where it is not the sensor's ({', '.join(FRAMED)}); may be repeated"
    c.add_argument("--frame", type=_pair, action="append", default=[], metavar="SENSOR=FRAME", help=frame)
    joint = "joint to set in --urdf; default: the one directly above the sensor's link; may be repeated"
    c.add_argument("--joint", type=_pair, action="append", default=[], metavar="SENSOR=JOINT", help=joint)
    c.add_argument("--quiet", "-q", action="store_true", help="do not print what the format cannot hold")
    c.set_defaults(run=_export)


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise argparse.ArgumentTypeError(f"must be SENSOR=NAME, but is {text!r}")
    return name, value


def _export(options: argparse.Namespace) -> None:
    from icalib.base.files import refuse_foreign, sealed_texts, set_of, write_texts
    from icalib.export.formats import ONE_FILE, export
    from icalib.result import load_calibration

    calibration = load_calibration(options.result)
    exported = export(calibration, options.to, dict(options.frame), options.urdf, dict(options.joint))
    files, folder = exported.files, options.output
    if options.to in ONE_FILE:
        files, folder = {options.output.name: next(iter(files.values()))}, options.output.parent
    # The same URDF as input and output: update in place.
    in_place = options.urdf is not None and options.output.resolve() == options.urdf.resolve()
    inputs = [*set_of(options.result), *([options.urdf] if options.urdf else [])]
    refuse_foreign((folder / name for name in files if not in_place), inputs, "choose another place")
    write_texts(folder, sealed_texts(files))
    if not options.quiet:
        for sentence in exported.sentences:
            print(f"Note: {sentence}")
        print(f"Wrote {', '.join(str(folder / name) for name in files)}.")


def _add_check(commands: argparse._SubParsersAction[CommandParser]) -> None:
    about = "check whether a calibration is still valid on a new recording"
    codes = "Exit code 0: valid, 1: changed, 2: an error, 3: the new recording is too poor to decide."
    c = add_command(
        commands,
        "check",
        about,
        "icalib check result new.bag",
        "icalib check result new.bag --sigma 4 --json check.json --topic cam0=/left/image_raw",
        codes=codes,
    )
    c.add_argument("result", type=file_path, help="folder that a calibration was written to")
    c.add_argument("recording", type=file_path, nargs="+", help="bag or folder of a new recording of the same rig")
    add_part(c)
    for field in ("topic", "path"):
        text = f"{field} of a sensor in the new recording, if it is not that of the calibration; may be repeated"
        c.add_argument(f"--{field}", type=_pair, action="append", default=[], metavar="SENSOR=NAME", help=text)
    sigma = "ignore changes that chance explains up to N sigma; default: 3"
    c.add_argument("--sigma", type=float, default=3.0, metavar="N", help=sigma)
    c.add_argument("--json", type=file_path, metavar="FILE", help="write residuals, drift and verdict as JSON")
    c.add_argument("--html", type=file_path, metavar="FILE", help="write verdict, changes and residuals as a page")
    c.add_argument("--quiet", "-q", action="store_true", help="print nothing; use the exit code")
    c.set_defaults(run=_check, error_code=2)


def _check(options: argparse.Namespace) -> int:
    from icalib.base.files import refuse_unwritable, set_of, write_sealed
    from icalib.cli.console import console_progress
    from icalib.result import load_calibration
    from icalib.tools.check import check_calibration, check_html, check_json, lines, with_places

    refuse_unwritable((options.json, options.html), (*set_of(options.result), *options.recording))
    calibration = load_calibration(options.result)
    calibration = with_places(calibration, topic=dict(options.topic), path=dict(options.path))
    with console_progress(options.quiet) as progress:
        part = {"start_s": options.start_s, "end_s": options.end_s}
        check = check_calibration(calibration, options.recording, progress, sigma=options.sigma, **part)
    if options.json:
        write_sealed(options.json, check_json(check))
    if options.html:
        recordings = ", ".join(path.name for path in options.recording)
        write_sealed(options.html, check_html(check, f"{options.result.name} on {recordings}"))
    if not options.quiet:
        print("\n".join(lines(check)))
    return check.exit_code


def _add_rig(commands: argparse._SubParsersAction[CommandParser]) -> None:
    about = "write a result as a rig file, with its values fixed, as priors or as guesses"
    c = add_command(commands, "rig", about, "icalib rig result --as prior --output rig.yaml")
    c.add_argument("result", type=file_path, help="folder that a calibration was written to")
    how = "fixed at the values, priors with the sigma of the result, or guesses to start from"
    c.add_argument("--as", dest="treatment", required=True, choices=("fixed", "prior", "guess"), help=how)
    file = "rig file to write; never overwrites a file"
    c.add_argument("--output", "-o", type=file_path, required=True, metavar="FILE", help=file)
    c.add_argument("--quiet", "-q", action="store_true", help="do not print which values could not be written as asked")
    c.set_defaults(run=_rig)


def _rig(options: argparse.Namespace) -> None:
    from icalib.base.files import refuse_existing, sealed, write_new
    from icalib.result import load_calibration
    from icalib.result.saving import rig_text

    refuse_existing(options.output)
    text, sentences = rig_text(load_calibration(options.result), options.treatment)
    write_new(options.output, sealed(text.encode()).decode())
    if not options.quiet:
        for sentence in sentences:
            print(f"Note: {sentence}")
        print(f"Wrote {options.output}.")


def _add_compare(commands: argparse._SubParsersAction[CommandParser]) -> None:
    kinds = "folder of a result, Kalibr camchain or imu file, URDF, or rig file with typed values"
    about = "show what changed between two calibrations, or other files of them"
    codes = "Exit code 0: the same, 1: something differs, 2: an error."
    c = add_command(
        commands,
        "compare",
        about,
        "icalib compare monday friday",
        "icalib compare cad.urdf result --tolerance mm=2 --tolerance deg=0.2",
        codes=codes,
    )
    c.add_argument("a", type=file_path, metavar="A", help=kinds)
    c.add_argument("b", type=file_path, metavar="B", help="the same")
    tolerance = "ignore differences up to this value, in deg, mm, ms, px or percent, as deg=0.1; may be repeated"
    c.add_argument("--tolerance", type=_tolerance, action="append", default=[], metavar="UNIT=VALUE", help=tolerance)
    c.add_argument("--sigma", type=float, default=3.0, metavar="N", help="ignore differences up to N sigma; default: 3")
    frame = "name in B of a sensor of A (in a URDF its link), if it differs; may be repeated"
    c.add_argument("--frame", type=_pair, action="append", default=[], metavar="SENSOR=NAME", help=frame)
    c.add_argument("--json", type=file_path, metavar="FILE", help="write the differences as JSON")
    c.add_argument("--html", type=file_path, metavar="FILE", help="write them as a page")
    c.add_argument("--quiet", "-q", action="store_true", help="print nothing; use the exit code")
    c.set_defaults(run=_compare, error_code=2)


def _tolerance(text: str) -> tuple[str, float]:
    from icalib.tools.comparison.compare import UNITS

    unit, _, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = -1.0
    if unit not in UNITS or not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(
            f"must be UNIT=VALUE with a unit of {', '.join(UNITS)} and a number from 0 up, but is {text!r}"
        )
    return unit, value


def _compare(options: argparse.Namespace) -> int:
    from icalib.base.files import refuse_unwritable, set_of, write_sealed
    from icalib.tools.comparison.compare import ComparisonTolerances, comparison_html, comparison_json, lines
    from icalib.tools.comparison.reading import compare_files

    inputs = [p for side in (options.a, options.b) for p in (side, *set_of(side))]
    refuse_unwritable((options.json, options.html), inputs)
    tolerances = ComparisonTolerances(**dict(options.tolerance))
    comparison = compare_files(options.a, options.b, dict(options.frame), tolerances, options.sigma)
    if options.json:
        write_sealed(options.json, comparison_json(comparison))
    if options.html:
        write_sealed(options.html, comparison_html(comparison))
    if not options.quiet:
        print("\n".join(lines(comparison)))
    return 0 if comparison.same else 1


def _add_view(commands: argparse._SubParsersAction[CommandParser]) -> None:
    about = "show a result and its recording in 3D over time, in Rerun"
    c = add_command(commands, "view", about, "icalib view result run.bag", "icalib view result --save result.rrd")
    c.add_argument("result", type=file_path, help="folder that a calibration was written to, or the result.json in it")
    c.add_argument("recording", type=file_path, nargs="?", help="the recording of the result, or one of them")
    file = "write a file for Rerun; default: start its viewer"
    c.add_argument("--save", type=file_path, metavar="FILE.rrd", help=file)
    c.add_argument("--quiet", "-q", action="store_true", help="print no progress, and not what is left out")
    c.set_defaults(run=_view)


def _view(options: argparse.Namespace) -> None:
    from icalib.base.files import refuse_foreign
    from icalib.cli.console import console_progress
    from icalib.tools.view import view

    if options.save is not None:
        refuse_foreign([options.save], [p for p in (options.recording,) if p], "choose another place")
    with console_progress(options.quiet) as progress:
        notes = view(options.result, options.recording, options.save, progress)
    if not options.quiet:
        for sentence in notes:
            print(f"Note: {sentence}")
        if options.save is not None:
            print(f"Wrote {options.save}: open it by `rerun {options.save}`.")


# The command `icalib target`: writes a calibration target as PDF for printing.

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

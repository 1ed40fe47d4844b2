"""The command line: it parses, calls the public function, and turns known errors into one line and exit code 1."""

from __future__ import annotations

import argparse
import io
import sys
import traceback
import warnings
from math import inf
from pathlib import Path

from icalib.errors import CalibrationError
from icalib.result_commands import add_result_commands

_MOST_IDS = 10_000  # more than any family has


def main(arguments: list[str] | None = None) -> int:
    """Entry point of the `icalib` command. Returns the exit code: 0 good, 1 an error, 2 wrong usage, 130 interrupted;
    of `compare` 1 where something differs, 2 an error; of `check` 1 changed, 2 an error, 3 cannot say."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names of files may have bytes that no encoding has
            stream.reconfigure(errors="backslashreplace")
    options = _parser().parse_args(arguments)
    if arguments is None and not sys.warnoptions:
        warnings.simplefilter("ignore", RuntimeWarning)  # numpy's, of which nobody at a terminal can make anything
    try:
        code = options.run(options)
    except CalibrationError as error:
        for note in () if getattr(options, "quiet", False) else getattr(error, "__notes__", ()):
            print(f"Note: {note}")
        print(f"icalib: {error}", file=sys.stderr)
        return getattr(options, "error_code", 1)
    except (OSError, MemoryError) as error:  # what fails outside of the program, and nobody expected there
        print(f"icalib: {_outside(error)}", file=sys.stderr)
        return getattr(options, "error_code", 1)
    except Exception as error:  # the last resort: a sentence says as much as a traceback does, to whoever reads it
        print(f"icalib: {_fault(error)}", file=sys.stderr)
        return getattr(options, "error_code", 1)
    except KeyboardInterrupt as stop:
        print(f"icalib: interrupted; {str(stop) or 'nothing was written.'}", file=sys.stderr)
        return 130
    return code or 0


def _outside(error: OSError | MemoryError) -> str:
    if isinstance(error, MemoryError):
        return "the memory of this machine is not enough; use --from and --to, or a machine with more."
    place = f"{error.filename} cannot be used: " if error.filename else ""
    return f"{place}{error.strerror or error}; check files, permissions and disks."


def _fault(error: Exception) -> str:
    frame = traceback.extract_tb(error.__traceback__)[-1]
    what = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return (
        f"failed in {Path(frame.filename).name}, line {frame.lineno} ({what}), which is a fault of icalib; please "
        "report it with the command."
    )


def _parser() -> argparse.ArgumentParser:
    from icalib import __version__

    parser = argparse.ArgumentParser(
        prog="icalib",
        description="Calibrates cameras, LiDARs, wheels, pose sensors and an IMU jointly, from recordings.",
    )
    parser.add_argument("--version", action="version", version=f"icalib {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    c = commands.add_parser("calibrate", help="calibrate the sensors of a rig from one recording or several")
    c.add_argument("rig", type=Path, help="rig file (rig.yaml)")
    several = "folder of the recording, or bag; several of one rig are solved jointly"
    c.add_argument("recording", type=Path, nargs="+", help=several)
    c.add_argument("--output", "-o", type=Path, required=True, help="folder for the results; made if it does not exist")
    _add_part(c)
    c.add_argument("--scheme", choices=("inertial", "pose", "kinematic"), help="where sensors are between nodes")
    c.add_argument("--loss", choices=("none", "huber", "cauchy"), help="robust loss on corners")
    c.add_argument("--segments", type=int, metavar="N", help="segments for the empirical factor; 0: none")
    strict = "exit code 3: usable with care, 4: partly usable, 5: not usable; by default 0 for all that was written"
    c.add_argument("--strict", action="store_true", help=strict)
    c.add_argument("--quiet", "-q", action="store_true", help="no progress bar and no table; warnings go to stderr")
    c.set_defaults(run=_calibrate)
    _add_inspect(commands)
    _add_target(commands)
    _add_simulate(commands)
    _add_montecarlo(commands)
    _add_fleet(commands)
    add_result_commands(commands)
    return parser


def _add_inspect(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    c = commands.add_parser("inspect", help="say what is in a recording, and whether it can be calibrated")
    c.add_argument("recording", type=Path, help="folder of the recording, or bag")
    c.add_argument("--rig", type=Path, metavar="FILE", help="write a draft of the rig file; never over another file")
    c.add_argument("--target", type=Path, metavar="FILE", help="YAML of the target, or a rig file: look for it")
    c.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON")
    _add_part(c)
    c.add_argument("--quiet", "-q", action="store_true", help="no progress bar and no table")
    c.set_defaults(run=_inspect)


def _add_part(parser: argparse.ArgumentParser) -> None:
    """Which part of a recording is used."""
    start = "use the recording from here on, in seconds from its start; by default all"
    parser.add_argument("--from", type=float, default=0.0, metavar="SECONDS", dest="start_s", help=start)
    parser.add_argument("--to", type=float, default=inf, metavar="SECONDS", dest="end_s", help="and up to here")


def _add_simulate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    c = commands.add_parser("simulate", help="make a recording whose truth is known")
    c.add_argument("scenario", type=Path, help="scenario file (scenario.yaml)")
    c.add_argument("--output", "-o", type=Path, required=True, help="where the recording goes; must not exist yet")
    c.add_argument("--seed", type=_whole, metavar="N", help="of motion and noise; by default the scenario's")
    levels = "data: tables of what is estimated from; sensor: a bag of what drivers send (.bag: ROS 1, else ROS 2)"
    c.add_argument("--level", choices=("data", "sensor"), default="data", help=levels)
    c.add_argument("--quiet", "-q", action="store_true", help="no progress bar and no last line")
    c.set_defaults(run=_simulate)


def _add_montecarlo(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    c = commands.add_parser("montecarlo", help="calibrate many simulated recordings, and judge the standard deviations")
    c.add_argument("scenario", type=Path, help="scenario file (scenario.yaml)")
    c.add_argument("--runs", type=_count, required=True, metavar="N", help="in all; those that are there already count")
    folder = "folder for runs and results; a study that was stopped goes on from what it holds"
    c.add_argument("--output", "-o", type=Path, required=True, help=folder)
    c.add_argument("--seed", type=_whole, metavar="N", help="of the first run; by default the scenario's")
    c.add_argument("--guess", choices=("none", "drawn"), default="none", help="drawn: about the truth; by default none")
    planes = "that LiDARs see, known as simulated, or found in their clouds; by default known"
    c.add_argument("--planes", choices=("known", "found"), default="known", help=planes)
    _add_workers(c)
    c.set_defaults(run=_montecarlo)
    r = commands.add_parser("reproduce", help="the paper's simulation again: errors against iterations, and a table")
    r.add_argument("--runs", type=_count, default=6, metavar="N", help="of each motion; figures show the first six")
    r.add_argument("--output", "-o", type=Path, required=True, help="folder for runs, figures and table")
    _add_workers(r)
    r.set_defaults(run=_reproduce)


def _add_fleet(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    c = commands.add_parser("fleet", help="calibrate many recordings of many robots, and say what changed over time")
    c.add_argument("jobs", type=Path, help="file of jobs (JOBS.yaml)")
    folder = "folder for the results; jobs that are there already are not done again unless their inputs changed"
    c.add_argument("--output", "-o", type=Path, required=True, help=folder)
    c.add_argument("--sigma", type=float, default=3.0, metavar="N", help="changes up to it do not count; by default 3")
    _add_workers(c)
    c.set_defaults(run=_fleet)


def _add_workers(parser: argparse.ArgumentParser) -> None:
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--workers", type=_count, metavar="N", help="processes on this machine; by default one a core")
    who.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster that does the work")
    parser.add_argument("--quiet", "-q", action="store_true", help="no progress bar and no table")


def _add_target(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """`icalib target TYPE`: its options are the fields of the rig file's target."""
    from icalib.printing import PAPERS

    t = commands.add_parser("target", help="print a target to PDF, at true scale")
    types = t.add_subparsers(required=True, metavar="TYPE", dest="type")
    fields = {
        "aprilgrid": {"rows": _count, "cols": _count, "tag_size": _metres, "tag_spacing": _metres},
        "charuco": {
            "squares_x": _count, "squares_y": _count, "square_size": _metres, "marker_size": _metres, "dictionary": str
        },
        "checkerboard": {"rows": _count, "cols": _count, "square_size": _metres},
        "circles": {"rows": _count, "cols": _count, "spacing": _metres, "diameter": _metres},
        "markers": {"family": str, "size": _metres, "ids": _ids},
        "tag": {"family": str, "id": _whole, "size": _metres},
    }  # fmt: skip
    for name, options in fields.items():
        one = types.add_parser(name, help=f"{name}, with the fields of the rig file")
        for field, kind in options.items():
            unit = {_metres: "METRES", _count: "N", _whole: "N", _ids: "0-11 or 0,3,7"}.get(kind, "NAME")
            one.add_argument(
                f"--{field.replace('_', '-')}",
                type=kind,
                required=True,
                metavar="RATIO" if field == "tag_spacing" else unit,
            )
        if name == "circles":
            one.add_argument("--asymmetric", action="store_true", help="every other row moved by one spacing")
            options = options | {"asymmetric": bool}
        elif name != "checkerboard":
            one.add_argument("--border-bits", type=_count, metavar="N", help="width of the tags' black border")
        one.add_argument("--paper", choices=tuple(PAPERS), default="a4")
        one.add_argument("--output", "-o", type=Path, required=True, metavar="FILE.pdf")
        one.set_defaults(run=_print_target, fields=tuple(options))


def _whole(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number, but is {text!r}")
    return int(text)


def _count(text: str) -> int:
    if _whole(text) == 0:
        raise argparse.ArgumentTypeError("must be at least 1, but is 0")
    return int(text)


def _ids(text: str) -> tuple[int, ...]:
    """Ids and ranges of ids, separated by commas."""
    ids: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        ids += range(_whole(first), _whole(last or first) + 1)
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
    from icalib.printing import write_target

    target = TARGETS[options.type](**{field: getattr(options, field) for field in options.fields})
    write_target(options.output, target, options.paper, getattr(options, "border_bits", None))
    print(f"{options.output}: print at 100 %, and measure the ruler.")


def _calibrate(options: argparse.Namespace) -> int:
    import dataclasses

    from icalib.calibration.verdict import EXIT_CODES
    from icalib.console import print_result, print_warnings, progress_bar
    from icalib.outputs import check_folder, write_outputs
    from icalib.pipeline import calibrate
    from icalib.rig_file import load_rig

    rig = load_rig(options.rig)
    chosen = {k: getattr(options, k) for k in ("scheme", "loss", "segments") if getattr(options, k) is not None}
    if chosen.get("segments", 0) < 0 or chosen.get("segments") == 1:
        raise CalibrationError("--segments must be 0 (none) or at least 2 segments.")
    rig = dataclasses.replace(rig, settings=dataclasses.replace(rig.settings, **chosen))
    check_folder(options.output, [options.rig, *options.recording])
    with progress_bar(options.quiet) as progress:
        result = calibrate(rig, options.recording, progress, start_s=options.start_s, end_s=options.end_s)
        progress("writing", 0.97)
        write_outputs(result, options.output)
    if options.quiet:
        print_warnings(result)
    else:
        print_result(result, options.output)
    return EXIT_CODES[result.verdict] if options.strict else 0


def _simulate(options: argparse.Namespace) -> None:
    from icalib.console import progress_bar
    from icalib.simulation import load_scenario, simulate, write_sensors, write_tables
    from icalib.simulation.tables import check_absent

    scenario = load_scenario(options.scenario)
    seed = scenario.seed if options.seed is None else options.seed
    check_absent(options.output)
    with progress_bar(options.quiet) as progress:
        simulation = simulate(scenario, seed, lambda stage, done: progress(stage, 0.6 * done))
        write = write_tables if options.level == "data" else write_sensors
        notes = write(simulation, seed, options.output, lambda done: progress("writing", 0.6 + 0.4 * done))
    if not options.quiet:
        for sentence in notes:
            print(f"Note: {sentence}")
        print(f"Wrote {options.output}, seed {seed}.")


def _montecarlo(options: argparse.Namespace) -> None:
    from icalib.console import progress_bar
    from icalib.montecarlo import Plan, run_file
    from icalib.montecarlo.console import print_study

    plan = Plan(options.runs, options.seed, options.guess, options.planes, options.workers, options.scheduler)
    with progress_bar(options.quiet) as progress:
        study = run_file(options.scenario, options.output, plan, progress)
    if not options.quiet:
        print_study(study, options.output)


def _reproduce(options: argparse.Namespace) -> None:
    from icalib.console import progress_bar
    from icalib.montecarlo import Plan
    from icalib.montecarlo.console import print_study
    from icalib.montecarlo.reproduce import reproduce

    plan = Plan(options.runs, guess="drawn", workers=options.workers, scheduler=options.scheduler)
    with progress_bar(options.quiet) as progress:
        studies = reproduce(options.output, plan, progress)
    if not options.quiet:
        for motion, study in studies.items():
            print_study(study, options.output / motion)
        print(f"Wrote {options.output / 'reproduce.html'}, and a PNG of each motion.")


def _fleet(options: argparse.Namespace) -> int:
    from icalib.console import progress_bar
    from icalib.fleet import Crew, run_fleet
    from icalib.fleet.console import print_fleet

    crew = Crew(options.workers, options.scheduler)
    say = (lambda sentence: None) if options.quiet else print
    with progress_bar(options.quiet) as progress:
        fleet = run_fleet(options.jobs, options.output, crew, options.sigma, progress, say)
    if not options.quiet:
        print_fleet(fleet, options.output)
    return 1 if fleet.failed else 0


def _inspect(options: argparse.Namespace) -> None:
    from icalib.console import progress_bar
    from icalib.inspection import draft_rig, inspect_recording, read_target, write_draft
    from icalib.inspection.console import print_inspection
    from icalib.inspection.draft import check_draft
    from icalib.inspection.figures import figures_json
    from icalib.own_files import refuse_foreign, sealed_texts
    from icalib.text_files import write_texts

    if options.rig:
        check_draft(options.rig)
    if options.json:
        if not options.json.parent.is_dir():
            raise CalibrationError(
                f"{options.json} cannot be written (its folder does not exist); choose another place."
            )
        refuse_foreign([options.json], [p for p in (options.recording, options.target) if p], "choose another place")
    target = read_target(options.target) if options.target else None
    with progress_bar(options.quiet) as progress:
        found = inspect_recording(options.recording, target, progress, start_s=options.start_s, end_s=options.end_s)
    if not options.quiet:
        print_inspection(found)
    if options.json:
        write_texts(options.json.parent, sealed_texts({options.json.name: figures_json(found)}))
    if options.rig:
        write_draft(draft_rig(found), options.rig)
        if not options.quiet:
            print(f"Wrote {options.rig}, a draft: check it, and fill in what is missing.")

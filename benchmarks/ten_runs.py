"""What the console says of ten recordings, one fault each.

python benchmarks/ten_runs.py FOLDER [NAME ...] [--seed N]

Each recording is simulated and calibrated with the rig file that a user would have. The console goes to
FOLDER/NAME.txt, the report to FOLDER/NAME.html. The verdict must be the expected one. The first reason must name the
true cause, or say that the cause is unknown; the exit code is 1 where it does not. About 8 processor seconds each.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from icalib.cli.console import print_result
from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import CalibrationError
from icalib.geometry.targets import AprilGrid
from icalib.pipeline import calibrate_measurements
from icalib.report import report_html
from icalib.result import Calibration
from icalib.rig import Parameter, Rig, Settings
from icalib.tools.simulation import Scenario, handheld, rig_for, simulate

SETTINGS = Settings()  # as a user has them
UNKNOWN = "the cause is unknown"


@dataclass(frozen=True)
class Run:
    """make: the rig file's content and the measurements; verdicts: those that are right; cause: what the first reason
    matches (regular expression)."""

    make: Callable[[int], tuple[Rig, Measurements]]
    verdicts: tuple[str, ...]
    cause: str


def recorded(
    scenario: Scenario, seed: int, lens: Literal["fixed", "start", "free"] = "fixed"
) -> tuple[Rig, Measurements]:
    """The rig of the scenario, its lenses known from before or to be found, and what was measured."""
    rig = rig_for(scenario, settings=SETTINGS, intrinsics=lens, distortion=lens)
    return rig, simulate(scenario, seed).measurements


def good(seed: int) -> tuple[Rig, Measurements]:
    return recorded(handheld(15.0), seed, lens="start")


def planar(seed: int) -> tuple[Rig, Measurements]:
    scenario = handheld(15.0)
    scenario = replace(scenario, motion=replace(scenario.motion, kind="planar"))
    rig = rig_for(scenario, settings=SETTINGS, rotation="start", translation="start")
    return rig, simulate(scenario, seed).measurements


def wrong_noise(seed: int) -> tuple[Rig, Measurements]:
    """Densities a fifth of the true ones."""
    rig, measurements = recorded(handheld(15.0), seed)
    assert rig.imu is not None
    return rig.with_(imu=replace(rig.imu, noise=rig.imu.noise.scaled(0.2))), measurements


def wrong_tag_size(seed: int) -> tuple[Rig, Measurements]:
    """Printed at 90 %, stated as designed."""
    rig, measurements = recorded(handheld(15.0), seed)
    return replace(rig, target=AprilGrid(6, 6, 0.088 / 0.9, 0.3)), measurements


def swapped_topics(seed: int) -> tuple[Rig, Measurements]:
    rig, measurements = recorded(handheld(15.0), seed, lens="start")
    rig = rig_for(handheld(15.0), settings=SETTINGS, rotation="start", translation="start", intrinsics="start")
    a, b = measurements.cameras
    return rig, measurements.with_streams(replace(b, name=a.name), replace(a, name=b.name))


def contradicted_prior(seed: int) -> tuple[Rig, Measurements]:
    """The position of cam0, measured to 5 mm and typed 60 mm off."""
    rig, measurements = recorded(handheld(15.0), seed)
    cam0, cam1 = rig.cameras
    truth = handheld(15.0).cameras[0].T_imu_sensor[:3, 3]
    stated = Parameter("prior", truth + [0.06, 0.0, 0.0], sigma=np.full(3, 0.005))
    return rig.with_(cameras=(replace(cam0, translation=stated), cam1)), measurements


def glitch(seed: int) -> tuple[Rig, Measurements]:
    """Something hits the rig: accelerations of 40 m/s^2 for 25 ms, which its readings do not resolve."""
    rig, measurements = recorded(handheld(15.0), seed)
    imu = measurements.imu
    assert imu is not None
    accel = imu.accel.copy()
    k = len(accel) // 2
    accel[k : k + 5] += [40.0, -25.0, 10.0]
    return rig, measurements.with_streams(replace(imu, accel=accel))


def clock_drift(seed: int) -> tuple[Rig, Measurements]:
    """The clock of cam0 runs 300 ppm fast: 4.5 ms over the recording."""
    rig, measurements = recorded(handheld(15.0), seed)
    cam0, cam1 = measurements.cameras
    return rig, measurements.with_streams(with_drift(cam0, 3e-4), cam1)


def with_drift(stream: CornerStream, rate: float) -> CornerStream:
    """Stamps of a clock that is fast by this share."""
    origin = stream.stamps_ns[0]
    return replace(stream, stamps_ns=origin + np.round((stream.stamps_ns - origin) * (1.0 + rate)).astype(np.int64))


def few_images(seed: int) -> tuple[Rig, Measurements]:
    """Four images of one camera without an IMU."""
    rig, measurements = recorded(handheld(8.0), seed, lens="free")
    few = thinned(measurements.cameras[0], 40)
    return rig.with_(imu=None, cameras=rig.cameras[:1]), measurements.only("cam0").with_streams(few)


def thinned(stream: CornerStream, step: int) -> CornerStream:
    """Every step-th image."""
    chosen = np.arange(0, len(stream.stamps_ns), step)
    rows = np.isin(stream.image, chosen)
    return stream.of_rows(rows, stream.stamps_ns[chosen], np.diff(stream.start)[chosen])


def unsynchronised_stereo(seed: int) -> tuple[Rig, Measurements]:
    """Two cameras without an IMU, stamped alike, but cam1 is exposed 15 ms later."""
    scenario = handheld(15.0)
    cameras = tuple(
        replace(c, time_offset_s=0.0, rate_hz=4.0, phase_s=0.015 * i) for i, c in enumerate(scenario.cameras)
    )
    rig, measurements = recorded(replace(scenario, cameras=cameras), seed, lens="free")
    cam0, cam1 = measurements.cameras
    return rig.with_(imu=None), measurements.without("imu0").with_streams(
        cam0, replace(cam1, stamps_ns=cam0.stamps_ns[: len(cam1.stamps_ns)])
    )


RUNS = {
    "good": Run(good, ("usable",), "^$"),
    "planar": Run(planar, ("partly usable",), "not determined"),
    "wrong_noise": Run(wrong_noise, ("usable with care", "not usable"), "noise"),
    "wrong_tag_size": Run(wrong_tag_size, ("not usable",), "target"),
    "swapped_topics": Run(swapped_topics, ("not usable",), "swapped"),
    "contradicted_prior": Run(contradicted_prior, ("not usable", "usable with care"), "prior of translation x of cam0"),
    "glitch": Run(glitch, ("not usable", "usable with care"), "comes at one time, near 7"),
    "clock_drift": Run(clock_drift, ("not usable", "usable with care"), "clock of cam0|cam0.*drift"),
    "few_images": Run(few_images, ("partly usable", "usable with care"), "images|segments"),
    "unsynchronised_stereo": Run(unsynchronised_stereo, ("not usable", "usable with care"), "not exposed together"),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", choices=[[], *RUNS], default=[])
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    wrong = 0
    for name in given.names or RUNS:
        failure = check(name, given.folder, given.seed)
        wrong += bool(failure)
        print(f"{name}: {failure or 'as expected'}")
    return 1 if wrong else 0


def check(name: str, folder: Path, seed: int) -> str:
    """Runs it, writes its console; what is wrong with it, or nothing."""
    run, shown = RUNS[name], io.StringIO()
    try:
        result = calibrate_measurements(*run.make(seed))
    except CalibrationError as error:
        (folder / f"{name}.txt").write_text(f"icalib: {error}\n")
        return "" if re.search(run.cause, str(error)) else f"refused: {error}"
    with contextlib.redirect_stdout(shown):
        print_result(result, folder / name)
    (folder / f"{name}.txt").write_text(shown.getvalue())
    (folder / f"{name}.html").write_text(report_html(result))
    return judged(run, result)


def judged(run: Run, result: Calibration) -> str:
    """What is wrong with verdict and first reason, or nothing."""
    first = result.reasons[0] if result.reasons else ""
    if result.verdict not in run.verdicts:
        return f"verdict {result.verdict!r}, expected {' or '.join(run.verdicts)}; first reason: {first}"
    if not re.search(run.cause, first) and UNKNOWN not in first:
        return f"first reason: {first}"
    return ""


if __name__ == "__main__":
    sys.exit(main())

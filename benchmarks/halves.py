"""How far two halves of a recording, each calibrated alone, disagree: with each part of the honest model on and off.

python benchmarks/halves.py [--data DIR]      DIR holds euroc_imu_april
"""

from __future__ import annotations

import argparse
import dataclasses
import os
from pathlib import Path

import numpy as np

from icalib.data.measurements import CornerStream, ImuStream, Measurements
from icalib.data.recordings import open_recording, read_measurements
from icalib.geometry import so3
from icalib.geometry.targets.base import SIZE_SIGMA
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, Rig
from icalib.rig.file import load_rig
from icalib.sensors.imu.spec import N_INTRINSICS, class_imperfections, class_of_noise

EXAMPLE = Path(__file__).parent.parent / "examples" / "euroc"
PLAIN = {"bloom": False, "board_shape": False, "blur_noise": False, "common_error": False}
MODELS = {
    "plain": PLAIN,
    "bloom": PLAIN | {"bloom": True},
    "bloom, shape": PLAIN | {"bloom": True, "board_shape": True},
    "bloom, shape, blur (default)": PLAIN | {"bloom": True, "board_shape": True, "blur_noise": True},
    "default and common error": {k: True for k in PLAIN},
}
IMPERFECT = "default, priors on IMU and target"


def part(measurements: Measurements, start: float, stop: float) -> Measurements:
    """The measurements between two shares (0 to 1) of the IMU's recording."""
    imu = measurements.imu
    first, span = imu.origin_ns, int(imu.stamps_ns[-1]) - imu.origin_ns
    low, high = first + int(span * start), first + int(span * stop)
    m = (imu.stamps_ns >= low) & (imu.stamps_ns <= high)
    cameras = []
    for c in measurements.cameras:
        k = np.flatnonzero((c.stamps_ns >= low) & (c.stamps_ns <= high))
        a, b = c.start[k[0]], c.start[k[-1] + 1]
        cameras.append(CornerStream(c.name, c.stamps_ns[k], c.start[k[0] : k[-1] + 2] - a, c.point[a:b], c.uv[a:b]))
    return Measurements.of_streams(ImuStream(imu.name, imu.stamps_ns[m], imu.gyro[m], imu.accel[m]), *cameras)


def differences(a: Calibration, b: Calibration) -> tuple[dict[str, float], float, float]:
    """cam0's differences (deg, mm, us), and the RMS over extrinsics and offsets in formal and in printed deviations."""
    formal, printed, out = [], [], {}
    for g in a.groups:
        if g.name not in ("rotation", "translation", "time_offset"):
            continue
        h = b.group(g.sensor, g.name)
        d = so3.log(np.ascontiguousarray(g.value.T @ h.value)) if g.name == "rotation" else g.value - h.value
        formal.extend(d / np.hypot(g.std_formal, h.std_formal))
        printed.extend(d / np.hypot(g.std, h.std))
        if g.sensor == "cam0":
            unit = {"rotation": 180.0 / np.pi, "translation": 1e3, "time_offset": 1e6}[g.name]
            out[g.name] = unit * float(np.linalg.norm(d))
    return out, float(np.sqrt(np.mean(np.square(formal)))), float(np.sqrt(np.mean(np.square(printed))))


def with_model(rig: Rig, model: str | None, **settings: bool) -> Rig:
    """The rig with other settings and, where given, another camera model with nothing known of its parameters."""
    cameras = rig.cameras if model is None else tuple(dataclasses.replace(c, model=model) for c in rig.cameras)
    return rig.with_(cameras=cameras, settings=dataclasses.replace(rig.settings, **settings))


def with_priors(rig: Rig) -> Rig:
    """The rig with the default priors on the IMU's intrinsics and the size of the target."""
    assert rig.imu is not None
    prior = Parameter("prior", np.zeros(N_INTRINSICS), class_imperfections(class_of_noise(rig.imu.noise)).sigma)
    target = dataclasses.replace(rig.target, size_sigma=SIZE_SIGMA)
    return rig.with_(imu=dataclasses.replace(rig.imu, intrinsics=prior), target=target)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("ICALIB_DATA", "../shared/data")))
    data = parser.parse_args().data / "euroc_imu_april"
    fixed, free = load_rig(EXAMPLE / "rig.yaml"), load_rig(EXAMPLE / "rig-from-nothing.yaml")
    measurements = read_measurements(open_recording(data), fixed)
    halves = part(measurements, 0.0, 0.5), part(measurements, 0.5, 1.0)
    print("| intrinsics | model | deg | mm | us | formal | printed |\n|---|---|---|---|---|---|---|")
    for title, rig, model in (
        ("fixed", fixed, None),
        ("free, pinhole-radtan", free, "pinhole-radtan"),
        ("free, pinhole-radtan5", free, "pinhole-radtan5"),
        ("free, pinhole-equidistant", free, "pinhole-equidistant"),
    ):
        models = {name: with_model(rig, model, **settings) for name, settings in MODELS.items()}
        for name, own in (models | {IMPERFECT: with_priors(with_model(rig, model))}).items():
            one, two = (calibrate_measurements(own, h) for h in halves)
            d, formal, printed = differences(one, two)
            print(
                f"| {title} | {name} | {d['rotation']:.3f} | {d['translation']:.2f} | {d['time_offset']:.1f} "
                f"| {formal:.1f} | {printed:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()

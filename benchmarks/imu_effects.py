"""Which effect makes two halves of the EuRoC recording differ: each is undone in turn. Needs $ICALIB_DATA."""

import os
from pathlib import Path

import numpy as np
from halves import EXAMPLE, part
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from icalib.data.measurements import ImuStream, Measurements
from icalib.data.recordings import open_recording, read_measurements
from icalib.geometry import so3
from icalib.pipeline import calibrate_measurements
from icalib.rig import ImuNoise, Parameter, Rig
from icalib.rig.file import load_rig
from icalib.sensors.imu.spec import class_imperfections


def row(title: str, rig: Rig, streams: Measurements) -> float:
    """Print cam0's differences about its y [deg] and along the IMU's y [mm], the sum of squares of all six in formal
    and in printed standard deviations, and chi^2 per dof of the IMU in each half. Returns its chi^2."""
    one, two = (calibrate_measurements(rig, part(streams, low, low + 0.5)) for low in (0.0, 0.5))
    (A, B), (a, b) = ([c.group("cam0", name) for c in (one, two)] for name in ("rotation", "translation"))
    d = np.concatenate([so3.log(np.ascontiguousarray(A.value.T @ B.value)), b.value - a.value])
    formal = np.hypot([*A.std_formal, *a.std_formal], [*B.std_formal, *b.std_formal])
    squares = [sum((d / std) ** 2) for std in (formal, np.hypot([*A.std, *a.std], [*B.std, *b.std]))]
    fits = [[f for f in c.fits if f.sensor == "imu0"] for c in (one, two)]
    ratios = [f"{f.chi2 / f.dof:.2f}, {g.chi2 / g.dof:.2f}" for f, g in zip(*fits, strict=True)][:2]
    cells = [title, f"{np.rad2deg(d[1]):+.3f}", f"{1e3 * d[4]:+.2f}", f"{squares[0]:.0f}", f"{squares[1]:.1f}", *ratios]
    print(f"| {' | '.join(cells)} |", flush=True)
    return sum(f.chi2 for half in fits for f in half)


def main() -> None:
    ideal, sigma = load_rig(EXAMPLE / "rig-equidistant.yaml"), class_imperfections("industrial").sigma
    m = read_measurements(open_recording(Path(os.environ["ICALIB_DATA"]) / "euroc_imu_april"), ideal)
    stamps, gyro, accel, free = m.imu.stamps_ns, m.imu.gyro, m.imu.accel, Parameter("free", np.zeros(6))
    w, f = (CubicSpline(t := 1e-9 * (stamps - stamps[0]), x) for x in (gyro, accel))
    slope, wider = np.asarray(savgol_filter(accel, 7, 3, deriv=1, delta=5e-3, axis=0)), np.repeat([1.0, 10.0], [15, 9])
    priors = (Parameter("prior", np.zeros(24), s) for s in (sigma, sigma * wider))
    rig, wide = (ideal.with_("imu0", intrinsics=prior) for prior in priors)

    def read(gyro: np.ndarray = gyro, accel: np.ndarray = accel) -> Measurements:
        return Measurements.of_streams(ImuStream("imu0", stamps, gyro, accel), *m.cameras)

    row("nothing, ideal IMU", ideal, m)
    least, K = row("nothing", rig, m), np.zeros(9)
    for ms in (-2.0, -0.5, 0.5, 2.0):
        row(f"accelerometer {ms:+g} ms late", rig, read(accel=f(t + 1e-3 * ms)))
    row("gyroscope's filter, lag 2 ms", rig, read(gyro + 2e-3 * w(t, 1)))
    row("gyroscope's filter, symmetric, 5 ms", rig, read(gyro - 1.25e-5 * w(t, 2)))
    row("g-sensitivity, prior x 10", wide, m)
    row("bias walks x 10", rig.with_("imu0", noise=ImuNoise(3.4e-4, 1.94e-4, 4e-3, 3e-2)), m)
    for k, one in enumerate(np.eye(9).reshape(9, 3, 3)):  # a camera that turns by K rad per m/s^2 of force
        more, less = (row(f"mount {k} {s:+g}", rig, read(gyro + s * slope @ one.T)) - least for s in (1e-4, -1e-4))
        K[k] = 0.5e-4 * (less - more) / (more + less)
    row(f"mount, up to {abs(K).max():.1g} rad per m/s^2", rig, read(gyro + slope @ K.reshape(3, 3).T))
    row("size effect, ideal IMU", ideal.with_("imu0", size_effect=free), m)
    row("size effect", rig.with_("imu0", size_effect=free), m)


if __name__ == "__main__":
    main()

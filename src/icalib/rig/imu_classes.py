"""Noise and imperfections of IMUs by class of sensor, for a rig file that does not give its own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class ImuNoise:
    """Continuous-time noise: gyro rad/s/sqrt(Hz), gyro_walk rad/s^2/sqrt(Hz), accel m/s^2/sqrt(Hz), accel_walk
    m/s^3/sqrt(Hz)."""

    gyro: float
    gyro_walk: float
    accel: float
    accel_walk: float
    source: str = "rig file"  # or "default for a consumer IMU", printed with the result

    @property
    def densities(self) -> np.ndarray:
        """(4,) in the order of the fields."""
        return np.array([self.gyro, self.gyro_walk, self.accel, self.accel_walk])

    def scaled(self, factor: float) -> ImuNoise:
        """That of an IMU `factor` times as noisy."""
        four = (float(factor * density) for density in self.densities)
        return replace(self, **dict(zip(("gyro", "gyro_walk", "accel", "accel_walk"), four, strict=True)))


@dataclass(frozen=True)
class Imperfections:
    """Standard deviations of the parameters of Kalibr's scale-misalignment model (`motion.imu_model`) about the
    ideal IMU. Scales are relative; misalignments of an axis and the rotation between gyroscope and accelerometer are in
    rad; g-sensitivity is in rad/s per m/s^2."""

    accel_scale: float
    accel_misalignment: float
    gyro_scale: float
    gyro_misalignment: float
    rotation: float
    g_sensitivity: float

    @property
    def sigma(self) -> np.ndarray:
        """(24,) in the order of `INTRINSICS_LABELS`: diagonal and lower triangle of two matrices, ..."""
        lower = (0, 1, 0, 1, 1, 0)  # xx yx yy zx zy zz: 0 on the diagonal
        accel = [(self.accel_scale, self.accel_misalignment)[k] for k in lower]
        gyro = [(self.gyro_scale, self.gyro_misalignment)[k] for k in lower]
        return np.array([*accel, *gyro, *[self.rotation] * 3, *[self.g_sensitivity] * 9])


DEFAULT_CLASS = "consumer"
INTRINSICS_LABELS = (
    *(f"accel_{n}" for n in ("xx", "yx", "yy", "zx", "zy", "zz")),
    *(f"gyro_{n}" for n in ("xx", "yx", "yy", "zx", "zy", "zz")),
    *(f"gyro_rotation_{n}" for n in "xyz"),
    *(f"g_sensitivity_{a}{b}" for a in "xyz" for b in "xyz"),
)
N_INTRINSICS = len(INTRINSICS_LABELS)

# gyro, gyro_walk, accel, accel_walk in the units of ImuNoise. Where they come from:
# consumer: Bosch BMI160 of the TUM VI data set (Schubert et al., IROS 2018), as OpenVINS sets it for that data set.
# industrial: Analog Devices ADIS16448 as the EuRoC data set publishes it (Burri et al., IJRR 2016).
# tactical: Honeywell HG1700 data sheet, 0.125 deg/sqrt(h) and 0.065 ft/s/sqrt(h); its biases of 1 deg/h and 1 mg are
# taken as what the walks reach in an hour.
_FIGURES = {
    "consumer": (1.6e-4, 2.2e-5, 2.8e-3, 8.6e-4),
    "industrial": (1.7e-4, 1.94e-5, 2.0e-3, 3.0e-3),
    "tactical": (3.6e-5, 8.1e-8, 3.3e-4, 1.6e-4),
}
IMU_CLASSES = tuple(_FIGURES)

# Tolerances of data sheets are taken for two standard deviations, typical values for one. Gyroscope and accelerometer
# are turned against each other by what both are off the case: no sheet says that they are off together.
# consumer: InvenSense MPU-6050 (PS-MPU-6000A, tables 6.1 and 6.2): scales +-3 %, cross-axis sensitivity +-2 %, 0.1
# deg/s/g typical. MPU-9250 (PS-MPU-9250A, tables 1 and 2): the same scales and cross-axis sensitivity.
# industrial: Analog Devices ADIS16448: scales +-1 %, axes 0.2 deg (accelerometer) and 0.05 deg (gyroscope) from
# perpendicular, 0.5 deg to the case, 0.015 deg/s/g. ADIS16460, table 1: 1 %, 0.05 deg, 1 deg to the
# case, 0.01 deg/s/g.
# tactical: Safran STIM300 (TS1524): scales 300 ppm (accelerometer) and 500 ppm (gyroscope), axes 1 mrad, 1 deg/h/g
# after its compensation, all typical.
_IMPERFECTIONS = {
    "consumer": Imperfections(0.015, 0.01, 0.015, 0.01, 0.014, 1.8e-4),
    "industrial": Imperfections(0.005, 1.7e-3, 0.005, 4.4e-4, 6.2e-3, 2.7e-5),
    "tactical": Imperfections(3e-4, 1e-3, 5e-4, 1e-3, 1.4e-3, 4.9e-7),
}
# Of IMU intrinsics that are `free`: wider than any class, so that a first calibration is not led by its prior.
FREE = Imperfections(0.05, 0.05, 0.05, 0.05, 0.05, 0.01)
# An IMU is tactical if all its densities are at most so many times those of that class. Consumer and industrial IMUs
# have the same noise, and differ by their factory calibration: noise alone never makes an IMU industrial.
ALIKE = 2.0


def class_noise(name: str) -> ImuNoise:
    """The figures of one of IMU_CLASSES; their source says that they are defaults."""
    article = "an" if name[0] in "aeiou" else "a"
    return ImuNoise(*_FIGURES[name], source=f"default for {article} {name} IMU")


def class_imperfections(name: str) -> Imperfections:
    """Of one of IMU_CLASSES."""
    return _IMPERFECTIONS[name]


def class_of_noise(noise: ImuNoise) -> str:
    """The class of an IMU by its noise: the one that the figures come from, or tactical if they are that small, or else
    consumer."""
    own = next((name for name in IMU_CLASSES if class_noise(name).source == noise.source), None)
    if own is not None:
        return own
    is_tactical = bool((noise.densities <= ALIKE * np.array(_FIGURES["tactical"])).all())
    return "tactical" if is_tactical else DEFAULT_CLASS


def class_of_sigma(sigma: np.ndarray) -> str | None:
    """The class whose imperfections have standard deviations `sigma` (24,), or None."""
    return next((name for name, own in _IMPERFECTIONS.items() if np.array_equal(own.sigma, sigma)), None)

"""An IMU: its noise, its intrinsics, and how its readings are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from icalib.rig.imu_classes import (
    FREE,
    IMU_CLASSES,
    INTRINSICS_LABELS,
    N_INTRINSICS,
    ImuNoise,
    class_imperfections,
    class_of_noise,
)
from icalib.rig.parameter import Parameter
from icalib.rig.parameter_spec import ParameterSpec
from icalib.rig.sensor import PLAIN_TABLE, Axes, Sensor, TableLayout


@dataclass(frozen=True)
class TwoSources:
    """Topics or tables of an IMU whose gyroscope and accelerometer report apart."""

    gyro: str
    accel: str


AccelUnit = Literal["m/s^2", "g"]
GyroUnit = Literal["rad/s", "deg/s"]
BY_CLASS = Parameter("free")  # IMU intrinsics of which nothing is said; `free()` is another
_CLASS_PRIORS = {n: Parameter("prior", np.zeros(N_INTRINSICS), class_imperfections(n).sigma) for n in IMU_CLASSES}


@dataclass(frozen=True)
class ImuSensor(Sensor):
    """The inertial sensor; its frame is the body frame. Units and axes: of the readings as they are recorded; None: SI
    units (g is recognised), and the axes as they are. assumed: there is none, but an assumption of smooth motion in
    its place (see `initialize.assumed_motion`). intrinsics (24,): see `motion.imu_model`. They always
    have a prior: by default that of the IMU's class about the ideal IMU, a broad one where they are free, about the
    guess. What is fixed without a value is the ideal IMU."""

    sensor_type: ClassVar[str] = "imu"
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (
        ParameterSpec("intrinsics", N_INTRINSICS, "nuisance", "", INTRINSICS_LABELS, 1e-2, 0.1),
    )

    path: str | TwoSources
    noise: ImuNoise
    intrinsics: Parameter = BY_CLASS
    topic: str | TwoSources | None = None  # in a bag; None: those with the sensor's name, or the only ones
    accel_unit: AccelUnit | None = None
    gyro_unit: GyroUnit | None = None
    accel_axes: Axes | None = None
    gyro_axes: Axes | None = None
    assumed: bool = False
    pose_keyframes_s: float = 0.02  # between keyframes that poses alone place
    layout: TableLayout = PLAIN_TABLE

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.intrinsics is BY_CLASS:
            object.__setattr__(self, "intrinsics", _CLASS_PRIORS[class_of_noise(self.noise)])
        elif self.intrinsics.mode == "free":
            start = np.zeros(N_INTRINSICS) if self.intrinsics.value is None else self.intrinsics.value
            object.__setattr__(self, "intrinsics", Parameter("prior", start, FREE.sigma))

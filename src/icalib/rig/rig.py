"""The rig: all sensors of a robot, their target and the settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from icalib.errors import RigError
from icalib.geometry.targets import NoTarget, Target
from icalib.rig.gravity import ANYWHERE
from icalib.rig.settings import Settings
from icalib.sensors import SENSOR_KINDS
from icalib.sensors.camera.spec import Camera
from icalib.sensors.imu.spec import ImuSensor
from icalib.sensors.lidar.spec import Lidar
from icalib.sensors.parameter import check_fields
from icalib.sensors.pose.spec import PoseSensor
from icalib.sensors.sensor import ROTATION, Sensor
from icalib.sensors.wheels.spec import Wheels

T = TypeVar("T", bound=Sensor)
# Names for all sensors of a type: properties of `Rig`, and keyword arguments of `Rig.with_`.
_SHORT: dict[str, type[Sensor]] = {
    "imu": ImuSensor, "cameras": Camera, "lidars": Lidar, "wheels": Wheels, "poses": PoseSensor,
}  # fmt: skip


def by_name(*sensors: Sensor) -> dict[str, Sensor]:
    """`sensors` by name, for `Rig.sensors`. Raises RigError if two have the same name."""
    named = {sensor.name: sensor for sensor in sensors}
    if len(named) < len(sensors):
        twice = next(s.name for k, s in enumerate(sensors) if s.name in {x.name for x in sensors[:k]})
        raise RigError(f"the rig has two sensors called {twice}; rename one of them.")
    return named


@dataclass(frozen=True)
class Rig:
    """All sensors of a robot, the target that they see, and the settings of the estimator.

    sensors: by name; sorted by kind in the order of `SENSOR_KINDS`, and as given within a kind. gravity, gravity_sigma:
    magnitude and its standard deviation [m/s^2]; 0: exact. path: the rig file, None if not read from one. body: name of
    the sensor in whose frame results give poses; empty: `reference`.

    The reference is the IMU, or without one the first sensor that determines the motion (`reference_without_imu`). A
    rig with cameras only has no motion model: images with the same stamp share a pose, and poses are independent. Any
    other rig without an IMU assumes smooth motion. Raises RigError if two sensors have the same name.
    """

    sensors: Mapping[str, Sensor]
    target: Target = NoTarget()
    gravity: float = ANYWHERE.value
    gravity_sigma: float = ANYWHERE.sigma
    settings: Settings = Settings()
    path: Path | None = None
    body: str = ""

    def __post_init__(self) -> None:
        by_name(*self.sensors.values())
        ordered = sorted(self.sensors.values(), key=lambda s: SENSOR_KINDS.index(s.sensor_type))
        object.__setattr__(self, "sensors", {s.name: s for s in ordered})

    def of(self, kind: type[T]) -> tuple[T, ...]:
        """All sensors of class `kind`, in the order of the rig file."""
        return tuple(s for s in self.sensors.values() if isinstance(s, kind))

    @property
    def mounted(self) -> tuple[Sensor, ...]:
        """All sensors except the IMU; their extrinsics are relative to `reference`."""
        return tuple(s for s in self.sensors.values() if s is not self.imu)

    @property
    def imu(self) -> ImuSensor | None:
        """The IMU; None if the rig has none."""
        return next(iter(self.of(ImuSensor)), None)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return self.of(Camera)

    @property
    def lidars(self) -> tuple[Lidar, ...]:
        return self.of(Lidar)

    @property
    def wheels(self) -> tuple[Wheels, ...]:
        return self.of(Wheels)

    @property
    def poses(self) -> tuple[PoseSensor, ...]:
        return self.of(PoseSensor)

    @property
    def has_target(self) -> bool:
        """True if there is a target. Without one, all cameras use feature tracks."""
        return len(self.target.bodies) > 0

    @property
    def blooms(self) -> bool:
        """True if edge bloom (dark edges shifted by blur and camera response) is estimated: `settings.bloom` is set and
        the corners of the target are subject to it."""
        return self.settings.bloom and self.target.blooms

    @property
    def reference(self) -> str:
        """Name of the sensor whose frame and clock the estimator uses; extrinsics and time offsets refer to it."""
        return self.reference_without_imu if self.imu is None else self.imu.name

    @property
    def reference_without_imu(self) -> str:
        """Name of the reference sensor if the rig has no IMU: the first that determines the motion without an IMU, else
        the first with a rotation that would determine it together with one, else the first that drives."""
        alone = (s for s in self.mounted if s.gives_motion_without_imu(self.has_target))
        together = (s for s in self.mounted if s.gives_motion and ROTATION in s.specs())
        return next(s.name for s in (*alone, *together, *(s for s in self.mounted if s.drives), *self.mounted))

    @property
    def moves_by_poses(self) -> bool:
        """True if the first pose sensor defines the motion of a rig without an IMU: no camera sees a target."""
        return bool(self.poses) and not (self.cameras and self.has_target)

    @property
    def cameras_alone(self) -> bool:
        """True if all sensors are cameras."""
        return len(self.cameras) == len(self.sensors)

    @property
    def assumes_motion(self) -> bool:
        """True if the IMU is not a real sensor, but stands for an assumption of smooth motion."""
        return self.imu is not None and self.imu.assumed

    def only(self, *names: str, **fields: Any) -> Rig:
        """A copy with only the sensors `names`, and with the fields of `Rig` in `fields` replaced."""
        return dataclasses.replace(self, sensors={n: s for n, s in self.sensors.items() if n in names}, **fields)

    def without(self, *names: str, **fields: Any) -> Rig:
        """A copy without the sensors `names`, and with the fields of `Rig` in `fields` replaced."""
        return self.only(*(n for n in self.sensors if n not in names), **fields)

    def with_sensors(self, *changed: Sensor, **fields: Any) -> Rig:
        """A copy with `changed` sensors added, or in place of those of the same name, and other `fields` of `Rig`."""
        return dataclasses.replace(self, sensors={**self.sensors, **by_name(*changed)}, **fields)

    def with_(self, part: str = "", /, **fields: Any) -> Rig:
        """A copy with some `fields` changed: those of the sensor named `part`, of "settings", or (default) of the rig.

        For example rig.with_("cam0", intrinsics=icalib.fixed([458, 457, 367, 248])). The fields imu, cameras, lidars,
        wheels and poses of the rig replace all sensors of that type. Raises RigError if the sensor or field does not
        exist, or the value has another type.
        """
        if not part:
            return self._with_fields(fields)
        if part == "settings":
            check_fields(part, self.settings, fields)
            return dataclasses.replace(self, settings=dataclasses.replace(self.settings, **fields))
        if part not in self.sensors:
            raise RigError(f"there is no sensor {part}; the rig has {', '.join(('settings', *self.sensors))}.")
        check_fields(part, self.sensors[part], fields)
        return self.with_sensors(dataclasses.replace(self.sensors[part], **fields))

    def _with_fields(self, fields: dict[str, Any]) -> Rig:
        """A copy with `fields` of the rig replaced. Names in _SHORT, such as "cameras", replace all sensors of a
        type."""
        plain = {name: value for name, value in fields.items() if name not in _SHORT}
        check_fields("the rig", self, plain)
        sensors = list(self.sensors.values())
        for name, value in fields.items():
            if name in _SHORT:
                sensors = [s for s in sensors if not isinstance(s, _SHORT[name])]
                sensors += _several(value)
        return dataclasses.replace(self, **({"sensors": by_name(*sensors)} | plain))


def _several(value: Sensor | Iterable[Sensor] | None) -> tuple[Sensor, ...]:
    if value is None:
        return ()
    return (value,) if isinstance(value, Sensor) else tuple(value)

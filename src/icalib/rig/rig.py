"""The rig: all sensors of a robot, their target and the settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from icalib.errors import RigError
from icalib.geometry.targets import NoTarget, Target
from icalib.rig.settings import Settings
from icalib.sensors import SENSOR_KINDS
from icalib.sensors.camera.spec import Camera
from icalib.sensors.imu.spec import ImuSensor
from icalib.sensors.lidar.spec import Lidar
from icalib.sensors.parameter import check_fields
from icalib.sensors.pose.spec import PoseSensor
from icalib.sensors.sensor import Sensor
from icalib.sensors.wheels.spec import Wheels

T = TypeVar("T", bound=Sensor)
# Short names for all sensors of a type: properties of a rig, and fields of `Rig.with_`.
_SHORT: dict[str, type[Sensor]] = {
    "imu": ImuSensor, "cameras": Camera, "lidars": Lidar, "wheels": Wheels, "poses": PoseSensor,
}  # fmt: skip


def by_name(*sensors: Sensor) -> dict[str, Sensor]:
    """The sensors by name, as `Rig` takes them. Raises RigError for two of one name."""
    found = {sensor.name: sensor for sensor in sensors}
    if len(found) < len(sensors):
        twice = next(s.name for k, s in enumerate(sensors) if s.name in {x.name for x in sensors[:k]})
        raise RigError(f"the rig has two sensors called {twice}; rename one of them.")
    return found


@dataclass(frozen=True)
class Rig:
    """All sensors of a robot, what they see, and how they are calibrated.

    sensors: by name; sorted by kind in the order of `SENSOR_KINDS`, and as given within a kind. gravity: m/s^2. body:
    name of the sensor in whose frame results give poses; empty: `reference`. The reference is the IMU, or without one
    the first camera, or the first pose sensor if no camera sees a target. Cameras alone have no motion model: images of
    the same stamp share a pose, and poses are independent. Any other rig without an IMU assumes smooth motion.
    """

    sensors: Mapping[str, Sensor]
    target: Target = NoTarget()
    gravity: float = 9.81
    settings: Settings = Settings()
    path: Path | None = None
    body: str = ""

    def __post_init__(self) -> None:
        by_name(*self.sensors.values())
        ordered = sorted(self.sensors.values(), key=lambda s: SENSOR_KINDS.index(s.sensor_type))
        object.__setattr__(self, "sensors", {s.name: s for s in ordered})

    def of(self, kind: type[T]) -> tuple[T, ...]:
        """All sensors of a type, in the order of the rig file."""
        return tuple(s for s in self.sensors.values() if isinstance(s, kind))

    @property
    def mounted(self) -> tuple[Sensor, ...]:
        """All sensors but the IMU: those that have a pose relative to it."""
        return tuple(s for s in self.sensors.values() if s is not self.imu)

    @property
    def imu(self) -> ImuSensor | None:
        """The IMU that is integrated; None without one."""
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
        """Whether there is a target. Without one all cameras have feature tracks."""
        return len(self.target.bodies) > 0

    @property
    def blooms(self) -> bool:
        """Whether edge bloom is estimated: the settings ask for it, and the target has edges that bloom."""
        return self.settings.bloom and self.target.blooms

    @property
    def reference(self) -> str:
        """Name of the sensor whose frame and clock the estimator uses: extrinsics of the rig are relative to it."""
        return self.reference_without_imu if self.imu is None else self.imu.name

    @property
    def reference_without_imu(self) -> str:
        """Name of the reference sensor of a rig without an IMU: the first that determines the motion alone, or
        else the first that does beside an IMU."""
        alone = (s for s in self.mounted if s.gives_motion_without_imu(self.has_target))
        return next(s.name for s in (*alone, *(s for s in self.mounted if s.gives_motion)))

    @property
    def moves_by_poses(self) -> bool:
        """Whether a rig without an IMU takes its motion from the first pose sensor: no camera sees a target."""
        return bool(self.poses) and not (self.cameras and self.has_target)

    @property
    def cameras_alone(self) -> bool:
        """Whether there are cameras and no other sensor."""
        return len(self.cameras) == len(self.sensors)

    @property
    def assumes_motion(self) -> bool:
        """Whether an assumption of smooth motion replaces the IMU."""
        return self.imu is not None and self.imu.assumed

    def only(self, *names: str, **fields: Any) -> Rig:
        """The same rig with no other sensors than these, and with other `fields` of its own."""
        return dataclasses.replace(self, sensors={n: s for n, s in self.sensors.items() if n in names}, **fields)

    def without(self, *names: str, **fields: Any) -> Rig:
        """The same rig without these sensors, and with other `fields` of its own."""
        return self.only(*(n for n in self.sensors if n not in names), **fields)

    def with_sensors(self, *changed: Sensor, **fields: Any) -> Rig:
        """The same rig with `changed` sensors in place of those of their names, or added, and with other `fields`."""
        return dataclasses.replace(self, sensors={**self.sensors, **by_name(*changed)}, **fields)

    def with_(self, part: str = "", /, **fields: Any) -> Rig:
        """The same rig with some `fields` changed: of the sensor called `part`, of "settings", or of the rig itself.

        For example rig.with_("cam0", intrinsics=icalib.fixed([458, 457, 367, 248])). The fields imu, cameras, lidars,
        wheels and poses of a rig stand for all sensors of their kind. Raises RigError where there is no such sensor or
        field, or a value is of another kind.
        """
        if not part:
            return self._with_own(fields)
        if part == "settings":
            check_fields(part, self.settings, fields)
            return dataclasses.replace(self, settings=dataclasses.replace(self.settings, **fields))
        if part not in self.sensors:
            raise RigError(f"there is no sensor {part}; the rig has {', '.join(('settings', *self.sensors))}.")
        check_fields(part, self.sensors[part], fields)
        return self.with_sensors(dataclasses.replace(self.sensors[part], **fields))

    def _with_own(self, fields: dict[str, Any]) -> Rig:
        own = {name: value for name, value in fields.items() if name not in _SHORT}
        check_fields("the rig", self, own)
        sensors = list(self.sensors.values())
        for name, value in fields.items():
            if name in _SHORT:
                sensors = [s for s in sensors if not isinstance(s, _SHORT[name])]
                sensors += _several(value)
        return dataclasses.replace(self, **({"sensors": by_name(*sensors)} | own))


def _several(value: Sensor | Iterable[Sensor] | None) -> tuple[Sensor, ...]:
    if value is None:
        return ()
    return (value,) if isinstance(value, Sensor) else tuple(value)

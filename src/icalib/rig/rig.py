"""The rig: all sensors of a robot, their target and the settings."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import radians, sin, sqrt
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from icalib.base.yaml_nodes import YamlValue
from icalib.errors import RigError
from icalib.geometry.targets import NoTarget, Target
from icalib.rig.scene import SCENE
from icalib.sensors import SENSOR_KINDS
from icalib.sensors.camera.spec import Camera
from icalib.sensors.imu.spec import ImuSensor
from icalib.sensors.lidar.spec import Lidar
from icalib.sensors.parameter import ToleranceSetting, check_fields
from icalib.sensors.pose.spec import PoseSensor
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.sensor import ROTATION, Sensor
from icalib.sensors.wheels.spec import Wheels

# Settings of the estimator: the section `settings` of the rig file.

Scheme = Literal["inertial", "pose", "kinematic"]
Loss = Literal["none", "huber", "cauchy"]
Keyframes = Literal["every-image", "first-camera"]


@dataclass(frozen=True)
class Settings:
    """Settings of the estimator, as in the rig file (docs/rig-file.md). The defaults suit every rig."""

    scheme: Scheme = "inertial"  # interpolation of poses between keyframes
    keyframes: Keyframes = "every-image"  # which images get a keyframe; first-camera: as in the iCalib paper
    loss: Loss = "huber"  # robust loss on corners
    loss_scale: float = 2.5  # residuals above this many standard deviations are down-weighted
    outlier_std: float = 4.0  # reject corners this many sigmas above the mean error of their image; 0: none
    outlier_min_px: float = 1.0  # corners with smaller errors are never rejected
    bloom: bool = True  # estimate edge bloom (dark edges shifted by blur and response), one value per camera
    board_shape: bool = True  # estimate deviations of the target from its design
    blur_noise: bool = True  # corner sigma grows with image speed (motion blur)
    common_error: bool = False  # corners of an image share a random shift; its sigma is estimated
    cache_corners: bool = True  # cache detected corners in the user's cache folder
    images_in_report: bool = True  # show a few recorded images in the report
    segments: int = 8  # number for the block jackknife (empirical factor); 0: no jackknife
    max_gap_s: float = 0.5  # IMU gaps up to this are bridged; longer ones split the recording
    keyframe_spacing_s: float = 0.05  # longest interval between consecutive keyframes
    # Constraint of tracked points to the planes that LiDARs see, as a standard deviation; 0: no constraint.
    points_on_planes_m: float = 0.0
    # The verdict on a parameter is `determined` if its standard deviation is at most its tolerance.
    rotation_tolerance_deg: float = 0.1
    translation_tolerance_m: float = 5e-3
    time_tolerance_s: float = 1e-3
    pixel_tolerance: float = 1.0  # px, of fx, fy, cx, cy

    def tolerance(self, name: ToleranceSetting) -> float:
        """Value of the setting `name`, a tolerance, in SI units (angles in rad) or px."""
        value = float(getattr(self, name))
        return math.radians(value) if name.endswith("_deg") else value


# The magnitude of gravity, and how well it is known.


class Gravity(NamedTuple):
    """Magnitude and its standard deviation [m/s^2]; sigma 0: exact."""

    value: float
    sigma: float


# On the ground of the earth it is 9.780 (equator) to 9.832 (poles), WGS84.
ANYWHERE = Gravity(9.806, 0.02)
ANOMALY_SIGMA = 5e-4  # m/s^2: gravity anomalies on land are 50 mGal and less (Pavlis et al., EGM2008, JGR 2012)


def gravity_at(latitude_deg: float, height_m: float) -> Gravity:
    """Normal gravity of WGS84 by Somigliana's formula, with the free-air gradient (NIMA TR8350.2, chapter 4)."""
    square = sin(radians(latitude_deg)) ** 2
    at_sea_level = 9.7803253359 * (1.0 + 0.00193185265241 * square) / sqrt(1.0 - 0.00669437999013 * square)
    return Gravity(at_sea_level - 3.086e-6 * height_m, ANOMALY_SIGMA)


def parse_gravity(value: YamlValue) -> Gravity:
    """Gravity from a number, which is exact, from {prior: VALUE, sigma: SIGMA}, or from {latitude: DEGREES, height:
    METRES}. Raises RigError naming line and field."""
    if not value.is_mapping:
        return Gravity(value.positive(), 0.0)
    names = ("latitude", "height") if "latitude" in value.entries() else ("prior", "sigma")
    fields = value.record(names)
    if names == ("prior", "sigma"):
        return Gravity(fields["prior"].positive(), fields["sigma"].positive())
    latitude = fields["latitude"].number()
    if abs(latitude) > 90.0:
        fields["latitude"].fail(f"is between -90 and 90 degrees, but is {latitude:g}; correct it.")
    return gravity_at(latitude, fields["height"].number())


def gravity_to_plain(gravity: Gravity) -> Any:
    """`gravity` as in a rig file."""
    return {"prior": gravity.value, "sigma": gravity.sigma} if gravity.sigma else gravity.value


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

    sensors: by name; sorted by kind in the order of `SENSOR_KINDS`, and as given within a kind, but the IMU that is the
    body comes first. gravity, gravity_sigma:
    magnitude and its standard deviation [m/s^2]; 0: exact. path: the rig file, None if not read from one. body: name of
    the sensor in whose frame results give poses; empty: `reference`.

    The reference is the IMU, of several the `body` or else the first; or without one the first sensor that determines
    the motion (`reference_without_imu`). A rig with cameras only has no motion model: images with the same stamp share
    a pose, and poses are independent. Any other rig without an IMU assumes smooth motion. Raises RigError if two
    sensors have the same name.
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
        ordered = sorted(
            self.sensors.values(),
            key=lambda s: (SENSOR_KINDS.index(s.sensor_type), s.is_inertial and s.name != self.body),
        )
        first = next((s.name for s in ordered if s.is_inertial), "")
        object.__setattr__(self, "sensors", {s.name: _as_mounted(s, s.name != first) for s in ordered})

    def of(self, kind: type[T]) -> tuple[T, ...]:
        """All sensors of class `kind`, in the order of the rig file."""
        return tuple(s for s in self.sensors.values() if isinstance(s, kind))

    @property
    def mounted(self) -> tuple[Sensor, ...]:
        """All sensors except the first IMU; their extrinsics are relative to `reference`."""
        return tuple(s for s in self.sensors.values() if s is not self.imu)

    @property
    def imu(self) -> ImuSensor | None:
        """The IMU that is the body; None if the rig has none."""
        return next(iter(self.of(ImuSensor)), None)

    @property
    def further_imus(self) -> tuple[ImuSensor, ...]:
        """The IMUs after the first, which are mounted on it."""
        return self.of(ImuSensor)[1:]

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
        """True if the first pose sensor defines the motion of a rig without an IMU: there is no LiDAR, and no camera
        sees a target."""
        return bool(self.poses) and not self.lidars and not (self.cameras and self.has_target)

    @property
    def cameras_alone(self) -> bool:
        """True if all sensors are cameras with global shutters: nothing depends on the motion between images."""
        return len(self.cameras) == len(self.sensors) and not any(c.rolling for c in self.cameras)

    @property
    def imus_alone(self) -> bool:
        """True if all sensors are IMUs."""
        return len(self.of(ImuSensor)) == len(self.sensors)

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


def _as_mounted(sensor: Sensor, mounted: bool) -> Sensor:
    """The sensor; an IMU knows whether it is mounted on another one."""
    if not isinstance(sensor, ImuSensor) or sensor.mounted == mounted:
        return sensor
    return dataclasses.replace(sensor, mounted=mounted)


def _several(value: Sensor | Iterable[Sensor] | None) -> tuple[Sensor, ...]:
    if value is None:
        return ()
    return (value,) if isinstance(value, Sensor) else tuple(value)


# Sensor classes by type, and the definitions of all parameters, collected from `SENSOR_KINDS` and `SCENE`.

SENSOR_TYPES: dict[str, type[Sensor]] = {
    kind.sensor_type: kind for kind in (ImuSensor, Camera, Lidar, Wheels, PoseSensor, PositionSensor)
}
_SENSOR_SPECS = (spec for kind in SENSOR_TYPES.values() for spec in kind.parameters)
ALL_SPECS = tuple(dict.fromkeys((*_SENSOR_SPECS, *SCENE)))  # without duplicates

# Parameter groups with a plural name -> name of a single number, such as radii -> radius.
ONE = {spec.name: spec.one for spec in ALL_SPECS if spec.one}

"""rig.yaml -> Rig, and a Rig -> plain data that loads back. The format: docs/rig-file.md."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import yaml

from icalib.base.file_names import NAME, NAME_WORDS
from icalib.base.yaml_nodes import YamlValue, parse_yaml, read_yaml
from icalib.geometry.cameras import CAMERA_MODELS
from icalib.geometry.targets import NoTarget, Scene, Target
from icalib.rig import Camera, ImuSensor, Lidar, Parameter, PoseSensor, Rig, Sensor, Settings, Wheels, by_name
from icalib.rig.complete import lack_of
from icalib.rig.file.fields import (
    TABLE,
    groups_to_plain,
    layout_to_plain,
    parameter_fields,
    parameters,
    path_or,
    table_layout,
    topic_or_none,
)
from icalib.rig.file.imu import imu_to_plain, read_imu
from icalib.rig.file.lidar import lidar_to_plain, read_lidar
from icalib.rig.file.poses import pose_sensor, pose_to_plain
from icalib.rig.file.targets import target_of, target_or_targets
from icalib.rig.file.wheels import read_wheels, wheels_to_plain
from icalib.rig.kinds import SENSOR_TYPES


def load_rig(path: str | Path) -> Rig:
    """Read a rig file. Raises RigError, one sentence naming file, line, field, what is wrong and what to do."""
    file = Path(path)
    return dataclasses.replace(_rig(read_yaml(file)), path=file)


def rig_from_dict(plain: dict[str, Any], source: str) -> Rig:
    """The rig that `rig_to_dict` gave as `plain`; `source` names it in sentences. Raises RigError as `load_rig`."""
    return _rig(parse_yaml(yaml.safe_dump(plain, sort_keys=False), source))


def _rig(root: YamlValue) -> Rig:
    found = root.record(("sensors",), ("target", "targets", "gravity", "settings"))
    sensors = _sensors(found["sensors"])
    blind = [c.name for c in sensors.cameras if c.tracks is None]
    targeted = "target" in found or "targets" in found
    if blind and not targeted:
        root.fail(
            "target is missing; add target, targets for several by name, or tracks (images, or a table of "
            f"tracks) of {' and '.join(blind)}."
        )
    _refuse_unseen_ground(found["sensors"], sensors, targeted)
    settings = _settings(found["settings"]) if "settings" in found else Settings()
    followed = any(c.tracks is not None for c in sensors.cameras)
    if settings.points_on_planes_m > 0.0 and not (sensors.lidars and followed):
        found["settings"].entries()["points_on_planes_m"].fail(
            "needs a LiDAR that sees planes, and a camera with feature tracks; remove it."
        )
    return Rig(
        by_name(*sensors.all),
        target_or_targets(root) if targeted else NoTarget(),
        gravity=found["gravity"].positive() if "gravity" in found else Rig.gravity,
        settings=settings,
    )


def load_target(path: str | Path) -> Target:
    """Read a target: a YAML file with the fields of the rig file's `target`, or one that has a `target` or `targets`.

    Raises RigError, one sentence naming file, line, field, what is wrong and what to do.
    """
    root = read_yaml(Path(path))
    has_its_own_field = {"target", "targets"} & set(root.entries())
    return target_or_targets(root) if has_its_own_field else target_of(root)


def rig_to_dict(rig: Rig) -> dict[str, Any]:
    """`rig` as lists, numbers and text; written as YAML or JSON, it loads back as the same rig. An empty path, as of a
    rig for arrays, is left out, and loads back as that of the rig file's default."""
    imus = {} if rig.imu is None else {rig.imu.name: imu_to_plain(rig.imu)}
    sensors = imus | {c.name: _camera_to_plain(c) for c in rig.cameras}
    sensors |= {s.name: lidar_to_plain(s) for s in rig.lidars} | {w.name: wheels_to_plain(w) for w in rig.wheels}
    sensors |= {s.name: pose_to_plain(s) for s in rig.poses}
    sensors = {name: {k: v for k, v in s.items() if (k, v) != ("path", "")} for name, s in sensors.items()}
    key = "targets" if isinstance(rig.target, Scene) else "target"
    target = {key: rig.target.plain()} if rig.has_target else {}
    return {
        "sensors": sensors,
        **target,
        "gravity": rig.gravity,
        "settings": dataclasses.asdict(rig.settings),
    }


@dataclass(frozen=True)
class _Sensors:
    """Those of each type, in the order of the file."""

    imus: list[ImuSensor] = field(default_factory=list)
    cameras: list[Camera] = field(default_factory=list)
    lidars: list[Lidar] = field(default_factory=list)
    wheels: list[Wheels] = field(default_factory=list)
    poses: list[PoseSensor] = field(default_factory=list)

    @property
    def all(self) -> list[Sensor]:
        return [*self.imus, *self.cameras, *self.lidars, *self.wheels, *self.poses]


def _sensors(value: YamlValue) -> _Sensors:
    found = _Sensors()
    for name, sensor in value.entries().items():
        if not NAME.fullmatch(name):
            sensor.fail(f"a sensor's name is {NAME_WORDS}, as in cam0; rename it.")
        fields = sensor.entries()
        if "type" not in fields:
            sensor.fail(f"type is missing; add type: {' or type: '.join(SENSOR_TYPES)}.")
        match fields["type"].choice("sensor type", tuple(SENSOR_TYPES)):
            case "camera":
                found.cameras.append(_camera(name, sensor))
            case "lidar":
                found.lidars.append(read_lidar(name, sensor))
            case "wheels":
                found.wheels.append(read_wheels(name, sensor))
            case "pose":
                found.poses.append(pose_sensor(name, sensor))
            case _ if found.imus:
                sensor.fail(f"is a second IMU beside {found.imus[0].name}; keep the one that is the body frame.")
            case _:
                found.imus.append(read_imu(name, sensor))
    _refuse_incomplete(value, found)
    return found


def _refuse_incomplete(value: YamlValue, found: _Sensors) -> None:
    """Where the sensors together cannot be calibrated."""
    imu = found.imus[0] if found.imus else None
    rig = Rig(by_name(*found.all))
    lack = lack_of(rig)
    if lack is not None:
        (value.entries()[lack.sensor] if lack.sensor else value).fail(lack.sentence)
    if imu is None:
        _refuse_clocks_of_nothing(value, found, rig.first_seeing)


def _refuse_clocks_of_nothing(value: YamlValue, found: _Sensors, body: str) -> None:
    """Clocks said to restart, without an IMU, that have no time offset; `body`: the sensor whose clock is the rig's."""
    timed = found.wheels or found.poses
    for sensor in (*found.cameras, *found.poses):
        if sensor.clock_restarts and (sensor.name == body or not timed):
            value.entries()[sensor.name].entries()["clock_restarts"].fail(
                (
                    f"without an IMU the clock of {body} is the reference clock; set clock_restarts of the other "
                    "sensors instead, or write false."
                )
                if timed
                else "cameras alone have no time offsets; remove it, or add a sensor of type: imu."
            )


def _refuse_unseen_ground(value: YamlValue, found: _Sensors, targeted: bool) -> None:
    """Ground that wheels are said to stand on, which nothing shows."""
    for wheels in found.wheels:
        if wheels.ground is None:
            continue
        field = value.entries()[wheels.name].entries()["ground"].entries()
        if wheels.ground.plane == "floor" and not found.lidars:
            field["plane"].fail("a LiDAR determines the floor, and there is none; write level.")
        if wheels.ground.plane == "level" and wheels.knows_height and not targeted:
            field["height_sigma"].fail(
                "the height is relative to the target, and there is none; remove it, or with a LiDAR write "
                "plane: floor."
            )


def _camera(name: str, value: YamlValue) -> Camera:
    options = ("path", "topic", "corner_noise", "tracks", "track_noise", *TABLE, *parameter_fields(Camera))
    found = value.record(("type", "model", "resolution"), options)
    model = found["model"].choice("camera model", tuple(CAMERA_MODELS))
    groups = parameters(found, Camera(name, "", model, (0, 0)).specs())
    _refuse_negative_focal_length(found, groups)
    return Camera(
        name=name,
        path=path_or(found, f"{name}/corners.csv"),
        model=model,
        resolution=_resolution(found["resolution"]),
        corner_noise_px=found["corner_noise"].positive() if "corner_noise" in found else None,
        topic=topic_or_none(found),
        tracks=found["tracks"].text() if "tracks" in found else None,
        track_noise_px=found["track_noise"].positive() if "track_noise" in found else None,
        layout=table_layout(found),
        **groups,
    )


def _refuse_negative_focal_length(found: dict[str, YamlValue], groups: dict[str, Parameter]) -> None:
    value = groups["intrinsics"].value if "intrinsics" in groups else None
    if value is not None and (value[:2] <= 0).any():
        found["intrinsics"].fail("fx and fy of [fx, fy, cx, cy] must be above 0 px; correct them.")


def _resolution(value: YamlValue) -> tuple[int, int]:
    sides = value.items()
    if len(sides) != 2:
        value.fail(f"must be [width, height] in pixels, but has {len(sides)} entries.")
    return sides[0].whole(1), sides[1].whole(1)


def _settings(value: YamlValue) -> Settings:
    kinds = get_type_hints(Settings)
    found = value.record((), tuple(kinds))
    return Settings(**{name: _setting(name, given, kinds[name]) for name, given in found.items()})


_MAY_BE_ZERO = ("outlier_std", "outlier_min_px", "points_on_planes_m")


def _setting(name: str, value: YamlValue, kind: Any) -> Any:
    if get_origin(kind) is Literal:
        return value.choice("such choice as", get_args(kind))
    if kind is bool:
        return value.boolean()
    if kind is int:
        return value.whole(0)
    return value.not_negative() if name in _MAY_BE_ZERO else value.positive()


def _camera_to_plain(camera: Camera) -> dict[str, Any]:
    plain: dict[str, Any] = {"type": "camera", "path": camera.path, "model": camera.model}
    plain["resolution"] = list(camera.resolution)
    if camera.topic is not None:
        plain["topic"] = camera.topic
    if camera.corner_noise_px is not None:
        plain["corner_noise"] = camera.corner_noise_px
    if camera.tracks is not None:
        plain["tracks"] = camera.tracks
    if camera.track_noise_px is not None:
        plain["track_noise"] = camera.track_noise_px
    return plain | layout_to_plain(camera.layout) | groups_to_plain(camera)

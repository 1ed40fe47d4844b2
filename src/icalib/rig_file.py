"""rig.yaml -> Rig, and a Rig -> plain data that loads back. The format: docs/rig-file.md."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from icalib.geometry.cameras import CAMERA_MODELS
from icalib.geometry.targets import NoTarget, Scene, Target
from icalib.imu_classes import DEFAULT_CLASS, IMU_CLASSES, class_noise
from icalib.rig import Camera, ImuNoise, ImuSensor, Parameter, Rig, Settings
from icalib.rig_parameters import imu_intrinsics_parameter, parameter_to_plain, rotation_parameter, vector_parameter
from icalib.rig_targets import NAME, target_of, target_or_targets
from icalib.yaml_nodes import YamlValue, read_yaml

_SENSOR_TYPES = ("imu", "camera")
_DENSITIES = ("gyro", "gyro_walk", "accel", "accel_walk")


def load_rig(path: str | Path) -> Rig:
    """Read a rig file. Raises RigError, one sentence naming file, line, field, what is wrong and what to do."""
    file = Path(path)
    root = read_yaml(file)
    found = root.record(("sensors",), ("target", "targets", "gravity", "settings"))
    imus, cameras = _sensors(found["sensors"])
    blind = [c.name for c in cameras if c.tracks is None]
    targeted = "target" in found or "targets" in found
    if blind and not targeted:
        root.fail(
            "target is missing; add target, targets for several by name, or tracks (a table of followed points) to "
            f"{' and '.join(blind)}."
        )
    return Rig(
        imu=imus[0] if imus else None,
        cameras=tuple(cameras),
        target=target_or_targets(root) if targeted else NoTarget(),
        gravity=found["gravity"].positive() if "gravity" in found else Rig.gravity,
        settings=_settings(found["settings"]) if "settings" in found else Settings(),
        path=file,
    )


def load_target(path: str | Path) -> Target:
    """Read a target: a YAML file with the fields of the rig file's `target`, or one that has a `target` or `targets`.

    Raises RigError, one sentence naming file, line, field, what is wrong and what to do.
    """
    root = read_yaml(Path(path))
    has_its_own_field = {"target", "targets"} & set(root.entries())
    return target_or_targets(root) if has_its_own_field else target_of(root)


def rig_to_dict(rig: Rig) -> dict[str, Any]:
    """`rig` as lists, numbers and text; written as YAML or JSON, it loads back as the same rig."""
    imus = {} if rig.imu is None else {rig.imu.name: _imu_to_plain(rig.imu)}
    sensors = imus | {c.name: _camera_to_plain(c) for c in rig.cameras}
    key = "targets" if isinstance(rig.target, Scene) else "target"
    target = {key: rig.target.plain()} if rig.has_target else {}
    return {
        "sensors": sensors,
        **target,
        "gravity": rig.gravity,
        "settings": dataclasses.asdict(rig.settings),
    }


def _sensors(value: YamlValue) -> tuple[list[ImuSensor], list[Camera]]:
    imus: list[ImuSensor] = []
    cameras: list[Camera] = []
    for name, sensor in value.entries().items():
        if not NAME.fullmatch(name):
            sensor.fail("a sensor's name is a letter, then letters, digits, _ or -, as in cam0; rename it.")
        fields = sensor.entries()
        if "type" not in fields:
            sensor.fail(f"type is missing; add type: {' or type: '.join(_SENSOR_TYPES)}.")
        if fields["type"].choice("sensor type", _SENSOR_TYPES) == "camera":
            cameras.append(_camera(name, sensor))
        elif imus:
            sensor.fail(f"is a second IMU beside {imus[0].name}; keep the one that is the body frame.")
        else:
            imus.append(_imu(name, sensor))
    if not cameras:
        value.fail("there is no camera; add a sensor of type: camera.")
    return imus, cameras


def _imu(name: str, value: YamlValue) -> ImuSensor:
    found = value.record(("type",), ("path", "topic", "noise", "intrinsics"))
    return ImuSensor(
        name=name,
        path=_path(found, f"{name}/data.csv"),
        noise=_noise(found["noise"]) if "noise" in found else class_noise(DEFAULT_CLASS),
        intrinsics=imu_intrinsics_parameter(found["intrinsics"]) if "intrinsics" in found else Parameter("fixed"),
        topic=_topic(found),
    )


def _noise(value: YamlValue) -> ImuNoise:
    if not value.is_mapping:
        return class_noise(value.choice("IMU class", IMU_CLASSES))
    found = value.record(_DENSITIES, ("source",))
    densities = {name: found[name].positive() for name in _DENSITIES}
    return ImuNoise(**densities, source=found["source"].text() if "source" in found else ImuNoise.source)


def _camera(name: str, value: YamlValue) -> Camera:
    groups = ("rotation", "translation", "time_offset", "intrinsics", "distortion", "bloom")
    found = value.record(
        ("type", "model", "resolution"), ("path", "topic", "corner_noise", "tracks", "track_noise", *groups)
    )
    model = found["model"].choice("camera model", tuple(CAMERA_MODELS))
    sizes = {"translation": 3, "time_offset": 1, "intrinsics": 4, "bloom": 1}
    sizes["distortion"] = len(CAMERA_MODELS[model].parameter_names) - sizes["intrinsics"]
    parameters = {group: vector_parameter(found[group], n) for group, n in sizes.items() if group in found}
    if "rotation" in found:
        parameters["rotation"] = rotation_parameter(found["rotation"])
    _refuse_negative_focal_length(found, parameters)
    return Camera(
        name=name,
        path=_path(found, f"{name}/corners.csv"),
        model=model,
        resolution=_resolution(found["resolution"]),
        corner_noise_px=found["corner_noise"].positive() if "corner_noise" in found else None,
        topic=_topic(found),
        tracks=found["tracks"].text() if "tracks" in found else None,
        track_noise_px=found["track_noise"].positive() if "track_noise" in found else None,
        **parameters,
    )


def _refuse_negative_focal_length(found: dict[str, YamlValue], parameters: dict[str, Parameter]) -> None:
    value = parameters["intrinsics"].value if "intrinsics" in parameters else None
    if value is not None and (value[:2] <= 0).any():
        found["intrinsics"].fail("fx and fy of [fx, fy, cx, cy] must be above 0 px; correct them.")


def _resolution(value: YamlValue) -> tuple[int, int]:
    sides = value.items()
    if len(sides) != 2:
        value.fail(f"must be [width, height] in pixels, but has {len(sides)} entries.")
    return sides[0].whole(1), sides[1].whole(1)


def _path(found: dict[str, YamlValue], default: str) -> str:
    return found["path"].text() if "path" in found else default


def _topic(found: dict[str, YamlValue]) -> str | None:
    return found["topic"].text() if "topic" in found else None


def _settings(value: YamlValue) -> Settings:
    kinds = get_type_hints(Settings)
    found = value.record((), tuple(kinds))
    return Settings(**{name: _setting(given, kinds[name]) for name, given in found.items()})


def _setting(value: YamlValue, kind: Any) -> Any:
    if get_origin(kind) is Literal:
        return value.choice("such choice as", get_args(kind))
    if kind is bool:
        return value.boolean()
    return value.whole(0) if kind is int else value.positive()


def _imu_to_plain(imu: ImuSensor) -> dict[str, Any]:
    plain: dict[str, Any] = {"type": "imu", "path": imu.path, "noise": dataclasses.asdict(imu.noise)}
    if imu.topic is not None:
        plain["topic"] = imu.topic
    intrinsics = parameter_to_plain(imu.intrinsics)
    return plain if intrinsics is None else plain | {"intrinsics": intrinsics}


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
    groups = {f.name: getattr(camera, f.name) for f in dataclasses.fields(camera)}
    return plain | {name: parameter_to_plain(p) for name, p in groups.items() if isinstance(p, Parameter)}

"""scenario.yaml -> Scenario. The format: docs/simulation.md."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np

from icalib.base.file_names import NAME, NAME_WORDS
from icalib.base.yaml_nodes import MOST_WHOLE, YamlValue, read_yaml
from icalib.errors import RigError
from icalib.geometry.targets import TARGETS
from icalib.rig import ImuNoise
from icalib.tools.simulation.scenario.effects import read_effects
from icalib.tools.simulation.scenario.image_faults import ImageFaults
from icalib.tools.simulation.scenario.projection import PARAMETER_COUNTS
from icalib.tools.simulation.scenario.robot import Drive, DriveKind, Features, SimLidar, SimPoses, SimWheels
from icalib.tools.simulation.scenario.room import Obstacle, Room, hills_of_slope
from icalib.tools.simulation.scenario.scenario import MODELS, Scenario, SimCamera, pose_from_rows
from icalib.tools.simulation.scenario.size import refuse_large
from icalib.tools.simulation.scenario.texture import Texture

_SENSOR_TYPES = ("imu", "camera", "lidar", "wheels", "pose")
_DENSITIES = ("gyro", "gyro_walk", "accel", "accel_walk")
_CLOCK = ("T_imu_sensor", "rate")
_CLOCK_OPTIONS = ("time_offset", "phase")
_START_NS = 1_700_000_000_000_000_000  # of all clocks, where the file gives none
_MARGIN_S = 3600.0  # by which clocks of sensors may differ
_STEEPEST_DEG = 45.0

Made = TypeVar("Made")


def load_scenario(path: str | Path) -> Scenario:
    """Read a scenario file. Raises RigError, one sentence naming file, line, field, what is wrong and what to do."""
    root = read_yaml(Path(path), "scenario file")
    found = root.record(
        ("duration", "sensors", "room", "motion"), ("effects", "features", "target", "images", "seed", "start_ns")
    )
    start_ns = found["start_ns"].whole(0) if "start_ns" in found else _START_NS
    duration_s = found["duration"].positive()
    if start_ns + _MARGIN_S * 1e9 + duration_s * 1e9 > MOST_WHOLE:
        found["start_ns" if "start_ns" in found else "duration"].fail("the last stamp would exceed 2^63 ns; lower it.")
    sensors = _sensors(found["sensors"], start_ns)
    room, motion = _room(found["room"]), _motion(found["motion"], Path(path).parent)
    features = _features(found["features"]) if "features" in found else None
    effects: dict[str, Any] = read_effects(found["effects"], sensors["poses"]) if "effects" in found else {}
    board: dict[str, Any] = _board(found["target"]) if "target" in found else {"board": False}
    scenario = _made(
        root,
        Scenario,
        duration_s=duration_s,
        motion=motion,
        imu_clock_origin_ns=start_ns,
        room=room,
        features=features,
        seed=found["seed"].whole(0) if "seed" in found else 0,
        image_faults=_image_faults(found["images"]) if "images" in found else ImageFaults(),
        **(sensors | effects),
        **board,
    )
    try:
        refuse_large(scenario)
    except RigError as error:
        found["duration"].fail(str(error))
    return scenario


def _made(value: YamlValue, kind: Callable[..., Made], /, **fields: Any) -> Made:
    """A `kind` of these fields; a RigError is told as one of `value`."""
    try:
        return kind(**fields)
    except RigError as error:
        value.fail(str(error))


def _sensors(value: YamlValue, start_ns: int) -> dict[str, Any]:
    """The fields of `Scenario` that the sensors fill."""
    imus: list[dict[str, Any]] = []
    cameras: list[SimCamera] = []
    lidars: list[SimLidar] = []
    wheels: list[SimWheels] = []
    poses: list[SimPoses] = []
    for name, sensor in value.entries().items():
        if not NAME.fullmatch(name):
            sensor.fail(f"a sensor's name is {NAME_WORDS}, as in cam0; rename it.")
        fields = sensor.entries()
        if "type" not in fields:
            sensor.fail(f"type is missing; add type: {' or type: '.join(_SENSOR_TYPES)}.")
        kind = fields["type"].choice("sensor type", _SENSOR_TYPES)
        if kind == "imu":
            imus.append(_imu(name, sensor))
        elif kind == "camera":
            cameras.append(_camera(name, sensor, start_ns))
        elif kind == "lidar":
            lidars.append(_lidar(name, sensor, start_ns))
        elif kind == "pose":
            poses.append(_poses(name, sensor, start_ns))
        else:
            wheels.append(_wheels(name, sensor, start_ns))
    if len(imus) != 1:
        value.fail(f"there must be one sensor of type: imu, not {len(imus)}; its frame is the robot's.")
    others = {"cameras": tuple(cameras), "lidars": tuple(lidars), "wheels": tuple(wheels), "poses": tuple(poses)}
    return imus[0] | others


def _imu(name: str, value: YamlValue) -> dict[str, Any]:
    if name != "imu0":
        value.fail("the IMU must be called imu0; rename it.")
    found = value.record(("type", "rate", "noise"), ("gyro_bias", "accel_bias"))
    densities = found["noise"].record(_DENSITIES)
    noise = ImuNoise(**{name: densities[name].positive() for name in _DENSITIES}, source="scenario")
    biases = {key: tuple(found[key].vector(3).tolist()) for key in ("gyro_bias", "accel_bias") if key in found}
    return {"imu_rate_hz": found["rate"].positive(), "imu_noise": noise} | biases


def _clock(found: dict[str, YamlValue], start_ns: int) -> dict[str, Any]:
    """What all sensors but the IMU have, by the names of their fields."""
    return {
        "time_offset_s": found["time_offset"].number() if "time_offset" in found else 0.0,
        "rate_hz": found["rate"].positive(),
        "phase_s": _least(found["phase"], 0.0) if "phase" in found else 0.0,
        "clock_origin_ns": start_ns,
    }


def _camera(name: str, value: YamlValue, start_ns: int) -> SimCamera:
    required = ("type", *_CLOCK, "model", "resolution", "intrinsics", "distortion", "noise_px")
    found = value.record(required, (*_CLOCK_OPTIONS, "dropouts"))
    model = found["model"].choice("camera model", MODELS)
    sides = found["resolution"].items()
    if len(sides) != 2:
        found["resolution"].fail(f"must be [width, height] in pixels, but has {len(sides)} entries.")
    return SimCamera(
        name,
        model,
        (sides[0].whole(1), sides[1].whole(1)),
        tuple(found["intrinsics"].vector(4).tolist()),
        tuple(found["distortion"].vector(PARAMETER_COUNTS[model]).tolist()),
        _pose(found["T_imu_sensor"]),
        corner_noise_px=_least(found["noise_px"], 0.0),
        dropouts=_intervals(found["dropouts"]) if "dropouts" in found else (),
        **_clock(found, start_ns),
    )


def _lidar(name: str, value: YamlValue, start_ns: int) -> SimLidar:
    options = ("rings", "azimuth_steps", "elevation_deg", "range", "noise")
    found = value.record(("type", *_CLOCK), _CLOCK_OPTIONS + options)
    chosen: dict[str, Any] = {key: found[key].whole(1) for key in ("rings", "azimuth_steps") if key in found}
    if "elevation_deg" in found:
        chosen["elevation_deg"] = _interval(found["elevation_deg"])
    if "range" in found:
        chosen["range_m"] = _interval(found["range"])
    if "noise" in found:
        chosen["range_noise_m"] = _least(found["noise"], 0.0)
    return SimLidar(name, _pose(found["T_imu_sensor"]), **chosen, **_clock(found, start_ns))


# What wheels must have, by what they report, and what noise they may have.
_DRIVES = {
    "rates": (("radii", "baseline"), ("noise", "slip", "allowed_slip", "poses_every")),
    "poses": (("radii", "baseline"), ("noise", "slip", "poses_every")),
    "twist": (("scales",), ("speed_noise", "yaw_noise", "allowed_slip")),
    "steering": (("radius", "wheelbase"), ("steering_offset", "noise", "steering_noise", "allowed_slip")),
}


def _wheels(name: str, value: YamlValue, start_ns: int) -> SimWheels:
    fields = value.entries()
    reports = fields["reports"].choice("reports", tuple(_DRIVES)) if "reports" in fields else SimWheels.reports
    required, options = _DRIVES[reports]
    found = value.record(("type", *_CLOCK, *required), (*_CLOCK_OPTIONS, *options, "reports", "sampling"))
    chosen: dict[str, Any] = {"reports": reports}
    for key in found.keys() & {*required, *options}:
        chosen[key] = _drive_value(key, found[key])
    if "sampling" in found:
        chosen["sampling"] = found["sampling"].choice("sampling", ("interval-mean", "instantaneous"))
    return SimWheels(name, _pose(found["T_imu_sensor"]), **chosen, **_clock(found, start_ns))


def _drive_value(key: str, value: YamlValue) -> Any:
    if key in ("radii", "scales"):
        two = value.items()
        if len(two) != 2:
            words = "[left, right] in metres" if key == "radii" else "[speed, yaw rate]"
            value.fail(f"must be {words}, but has {len(two)} entries.")
        return two[0].positive(), two[1].positive()
    if key == "poses_every":
        return value.whole(1)
    if key == "steering_offset":
        return value.number()
    return _least(value, 0.0) if key == "slip" or key.endswith("noise") else value.positive()


def _poses(name: str, value: YamlValue, start_ns: int) -> SimPoses:
    options = ("kind", "T_world_frame", "rotation_noise", "position_noise")
    found = value.record(("type", *_CLOCK), _CLOCK_OPTIONS + options)
    chosen: dict[str, Any] = {key: _least(found[key], 0.0) for key in options[2:] if key in found}
    if "kind" in found:
        chosen["kind"] = found["kind"].choice("kind", ("absolute", "relative"))
    if "T_world_frame" in found:
        chosen["T_world_frame"] = _pose(found["T_world_frame"])
    return SimPoses(name, _pose(found["T_imu_sensor"]), **chosen, **_clock(found, start_ns))


def _room(value: YamlValue) -> Room:
    found = value.record(("size",), ("blocks", "slope_deg", "texture"))
    blocks = tuple(_block(block) for block in found["blocks"].items()) if "blocks" in found else ()
    hills = None
    if "slope_deg" in found:
        slope = found["slope_deg"].positive()
        if slope > _STEEPEST_DEG:
            found["slope_deg"].fail(f"must be at most {_STEEPEST_DEG:g} degrees, but is {slope:g}.")
        hills = hills_of_slope(slope)
    texture = _texture(found["texture"]) if "texture" in found else Texture()
    return _made(value, Room, size=_triple(found["size"]), blocks=blocks, hills=hills, texture=texture)


def _texture(value: YamlValue) -> Texture:
    found = value.record((), ("seed", "share", "contrast"))
    chosen: dict[str, Any] = {key: _share(found[key]) for key in ("share", "contrast") if key in found}
    if "seed" in found:
        chosen["seed"] = found["seed"].whole(0)
    return Texture(**chosen)


def _image_faults(value: YamlValue) -> ImageFaults:
    found = value.record((), ("people", "gain_steps", "frozen", "robot_part", "dirt"))
    chosen: dict[str, Any] = {key: found[key].whole(0) for key in ("people", "dirt") if key in found}
    if "gain_steps" in found:
        steps = [step.vector(2).tolist() for step in found["gain_steps"].items()]
        if any(gain <= 0.0 for _, gain in steps):
            found["gain_steps"].fail("each entry is [instant, gain], with a gain above 0; correct it.")
        chosen["gain_steps"] = tuple(map(tuple, steps))
    if "frozen" in found:
        chosen["frozen"] = _intervals(found["frozen"])
    if "robot_part" in found:
        chosen["robot_part"] = _share(found["robot_part"])
    return ImageFaults(**chosen)


def _block(value: YamlValue) -> Obstacle:
    found = value.record(("center", "size"), ("yaw_deg", "ramp"))
    x, y = found["center"].vector(2).tolist()
    yaw = np.deg2rad(found["yaw_deg"].number()) if "yaw_deg" in found else 0.0
    return Obstacle((x, y), _triple(found["size"]), float(yaw), found["ramp"].boolean() if "ramp" in found else False)


def _motion(value: YamlValue, folder: Path) -> Drive:
    found = value.record(("kind",), ("exact", "axis_imu", "path", "sideslip_deg", "seed"))
    chosen: dict[str, Any] = {"kind": found["kind"].choice("motion", get_args(DriveKind))}
    if "exact" in found:
        chosen["exact"] = found["exact"].boolean()
    if "axis_imu" in found:
        chosen["axis_imu"] = tuple(found["axis_imu"].vector(3).tolist())
        if not any(chosen["axis_imu"]):
            found["axis_imu"].fail("must not be zero; give the direction of the axis.")
    if "path" in found:
        chosen["path"] = folder / found["path"].text()
    if "sideslip_deg" in found:
        chosen["sideslip_deg"] = _least(found["sideslip_deg"], 0.0)
    if "seed" in found:
        chosen["seed"] = found["seed"].whole(0)
    return _made(value, Drive, **chosen)


def _board(value: YamlValue) -> dict[str, Any]:
    """The fields of `Scenario` that say which target stands where."""
    fields = value.entries()
    if "type" not in fields:
        value.fail(f"type is missing; add type: {', type: '.join(TARGETS)}.")
    kind = TARGETS[fields["type"].choice("target type", tuple(TARGETS))]
    asked = [f for f in dataclasses.fields(kind) if f.init and f.name != "size_sigma"]
    required = tuple(f.name for f in asked if f.default is dataclasses.MISSING)
    optional = tuple(f.name for f in asked if f.name not in required)
    found = value.record(("type", "T_world_board", *required), optional)
    types = get_type_hints(kind)
    chosen = {f.name: _of_type(found[f.name], types[f.name]) for f in asked if f.name in found}
    return {"target": _made(value, kind, **chosen), "T_world_board": _pose(found["T_world_board"])}


def _of_type(value: YamlValue, kind: type) -> Any:
    if kind is bool:
        return value.boolean()
    if kind is str:
        return value.text()
    return value.whole(0) if kind is int else value.positive()


def _features(value: YamlValue) -> Features:
    found = value.record((), ("count", "persistent", "longest_track", "per_image", "range", "seed", "relief"))
    least = {"count": 1, "persistent": 0, "per_image": 1, "seed": 0}
    chosen: dict[str, Any] = {key: found[key].whole(n) for key, n in least.items() if key in found}
    named = {"longest_track": "longest_track_s", "range": "range_m"}
    chosen |= {field: found[key].positive() for key, field in named.items() if key in found}
    if "relief" in found:
        chosen["relief_m"] = _least(found["relief"], 0.0)
    features = Features(**chosen)
    if features.persistent > features.count:
        value.fail(f"{features.persistent} persistent points are more than all {features.count}; lower persistent.")
    return features


def _least(value: YamlValue, least: float) -> float:
    number = value.number()
    if number < least:
        value.fail(f"must be at least {least:g}, but is {number:g}.")
    return number


def _share(value: YamlValue) -> float:
    share = _least(value, 0.0)
    if share > 1.0:
        value.fail(f"must be at most 1, but is {share:g}.")
    return share


def _intervals(value: YamlValue) -> tuple[tuple[float, float], ...]:
    return tuple(_interval(item) for item in value.items())


def _interval(value: YamlValue) -> tuple[float, float]:
    low, high = value.vector(2).tolist()
    if low > high:
        value.fail(f"must be [lowest, highest], but is [{low:g}, {high:g}].")
    return low, high


def _triple(value: YamlValue) -> tuple[float, float, float]:
    """Three positive lengths."""
    sides = value.items()
    if len(sides) != 3:
        value.fail(f"must be a list of 3 numbers, but has {len(sides)}.")
    return sides[0].positive(), sides[1].positive(), sides[2].positive()


def _pose(value: YamlValue) -> np.ndarray:
    """4 x 4, its rotation made orthonormal."""
    rows = value.items()
    if len(rows) != 4:
        value.fail(f"must be 4 rows of 4 numbers, but has {len(rows)}.")
    T = np.array([row.vector(4) for row in rows])
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0.0 or (T[3] != [0, 0, 0, 1]).any():
        value.fail("is not a pose: its first three columns must be a rotation, its last row 0, 0, 0, 1; correct it.")
    return pose_from_rows(T)

"""Reads a scenario file; its format is described in docs/simulation.md."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np

from icalib.base.files import NAME, NAME_WORDS
from icalib.base.yaml_nodes import LARGEST_INTEGER, YamlValue, read_yaml
from icalib.errors import RigError
from icalib.geometry.targets import TARGETS, AprilGrid, Markers, Scene, Target
from icalib.kinds import simulated_kinds
from icalib.sensors import SENSOR_KINDS
from icalib.sensors.fields import choice_or
from icalib.tools.simulation.projection import PARAMETER_COUNTS
from icalib.tools.simulation.room import Obstacle, Room, Texture, hills_of_slope
from icalib.tools.simulation.scenario import (
    MODELS,
    ImageFaults,
    ImuSampling,
    Rolling,
    Scenario,
    SimCamera,
    SimSensor,
    at_least,
    handheld,
    imu_noise,
    intervals,
    mounted_fields,
    pose,
    read_effects,
    refuse_large,
    share,
    triple,
)
from icalib.tools.simulation.trajectory import Drive, DriveKind, Features

_START_NS = 1_700_000_000_000_000_000  # origin of all clocks if the file gives none
_MARGIN_S = 3600.0  # largest difference between clocks of sensors
_STEEPEST_DEG = 45.0

Made = TypeVar("Made")


def load_scenario(path: str | Path) -> Scenario:
    """Reads a scenario file. Raises RigError, one sentence naming file, line, field, what is wrong and what to do."""
    root = read_yaml(Path(path), "scenario file")
    fields = root.record(
        ("duration", "sensors", "room", "motion"), ("effects", "features", "target", "images", "seed", "start_ns")
    )
    start_ns = fields["start_ns"].whole(0) if "start_ns" in fields else _START_NS
    duration_s = fields["duration"].positive()
    if start_ns + _MARGIN_S * 1e9 + duration_s * 1e9 > LARGEST_INTEGER:
        fields["start_ns" if "start_ns" in fields else "duration"].fail(
            "the last stamp would exceed 2^63 ns; lower it."
        )
    sensors = _sensors(fields["sensors"], start_ns)
    room, motion = _room(fields["room"]), _motion(fields["motion"], Path(path).parent)
    features = _features(fields["features"]) if "features" in fields else None
    effects: dict[str, Any] = read_effects(fields["effects"], sensors["sensors"]) if "effects" in fields else {}
    board: dict[str, Any] = _board(fields["target"]) if "target" in fields else {"board": False}
    scenario = _construct(
        root,
        Scenario,
        duration_s=duration_s,
        motion=motion,
        imu_clock_origin_ns=start_ns,
        room=room,
        features=features,
        seed=fields["seed"].whole(0) if "seed" in fields else 0,
        image_faults=_image_faults(fields["images"]) if "images" in fields else ImageFaults(),
        **(sensors | effects),
        **board,
    )
    try:
        refuse_large(scenario)
    except RigError as error:
        fields["duration"].fail(str(error))
    return scenario


def _construct(value: YamlValue, kind: Callable[..., Made], /, **fields: Any) -> Made:
    """kind(**fields); a RigError is raised again with file, line and field of `value`."""
    try:
        return kind(**fields)
    except RigError as error:
        value.fail(str(error))


def _sensors(value: YamlValue, start_ns: int) -> dict[str, Any]:
    """The fields of `Scenario` that the section `sensors` sets, by name."""
    kinds = simulated_kinds()
    types = tuple(kind for kind in SENSOR_KINDS if kind in kinds or kind in ("imu", "camera"))
    imus: list[dict[str, Any]] = []
    cameras: list[SimCamera] = []
    others: list[SimSensor] = []
    for name, sensor in value.entries().items():
        if not NAME.fullmatch(name):
            sensor.fail(f"a sensor's name is {NAME_WORDS}, as in cam0; rename it.")
        fields = sensor.entries()
        if "type" not in fields:
            sensor.fail(f"type is missing; add type: {' or type: '.join(types)}.")
        kind = fields["type"].choice("sensor type", types)
        if kind == "imu" and name == "imu0":
            imus.append(_imu(sensor))
        elif kind == "camera":
            cameras.append(read_camera(name, sensor, start_ns))
        else:
            others.append(kinds[kind].parse(name, sensor, start_ns))
    if not imus:
        value.fail("there is no imu0 of type: imu, whose frame is the robot's; add it.")
    others.sort(key=lambda sensor: types.index(sensor.sensor_type))
    return imus[0] | {"cameras": tuple(cameras), "sensors": tuple(others)}


def _imu(value: YamlValue) -> dict[str, Any]:
    fields = value.record(("type", "rate", "noise"), ("gyro_bias", "accel_bias", "sampling"))
    noise = imu_noise(fields["noise"])
    biases = {key: tuple(fields[key].vector(3).tolist()) for key in ("gyro_bias", "accel_bias") if key in fields}
    sampling = choice_or(fields, "sampling", ImuSampling, Scenario.imu_sampling)
    return {"imu_rate_hz": fields["rate"].positive(), "imu_noise": noise, "imu_sampling": sampling} | biases


def read_camera(name: str, value: YamlValue, start_ns: int) -> SimCamera:
    """A camera from its section `value`; start_ns: origin of all clocks."""
    required = ("model", "resolution", "intrinsics", "distortion", "noise_px")
    fields, common = mounted_fields(value, start_ns, required, ("dropouts", "shutter"))
    model = fields["model"].choice("camera model", MODELS)
    sides = fields["resolution"].items()
    if len(sides) != 2:
        fields["resolution"].fail(f"must be [width, height] in pixels, but has {len(sides)} entries.")
    return SimCamera(
        name,
        model,
        (sides[0].whole(1), sides[1].whole(1)),
        tuple(fields["intrinsics"].vector(4).tolist()),
        tuple(fields["distortion"].vector(PARAMETER_COUNTS[model]).tolist()),
        corner_noise_px=at_least(fields["noise_px"], 0.0),
        dropouts=intervals(fields["dropouts"]) if "dropouts" in fields else (),
        **_shutter(fields),
        **common,
    )


def _shutter(fields: dict[str, YamlValue]) -> dict[str, Any]:
    """The fields of `SimCamera` for a rolling shutter; none for a global shutter."""
    if "shutter" not in fields:
        return {}
    shutter = fields["shutter"].record(("rolling", "readout"))
    return {"rolling": choice_or(shutter, "rolling", Rolling, "rows"), "readout_s": shutter["readout"].number()}


def _room(value: YamlValue) -> Room:
    fields = value.record(("size",), ("blocks", "slope_deg", "texture"))
    blocks = tuple(_block(block) for block in fields["blocks"].items()) if "blocks" in fields else ()
    hills = None
    if "slope_deg" in fields:
        slope = fields["slope_deg"].positive()
        if slope > _STEEPEST_DEG:
            fields["slope_deg"].fail(f"must be at most {_STEEPEST_DEG:g} degrees, but is {slope:g}.")
        hills = hills_of_slope(slope)
    texture = _texture(fields["texture"]) if "texture" in fields else Texture()
    return _construct(value, Room, size=triple(fields["size"]), blocks=blocks, hills=hills, texture=texture)


def _texture(value: YamlValue) -> Texture:
    fields = value.record((), ("seed", "share", "contrast"))
    chosen: dict[str, Any] = {key: share(fields[key]) for key in ("share", "contrast") if key in fields}
    if "seed" in fields:
        chosen["seed"] = fields["seed"].whole(0)
    return Texture(**chosen)


def _image_faults(value: YamlValue) -> ImageFaults:
    fields = value.record((), ("people", "gain_steps", "frozen", "robot_part", "dirt"))
    chosen: dict[str, Any] = {key: fields[key].whole(0) for key in ("people", "dirt") if key in fields}
    if "gain_steps" in fields:
        steps = [step.vector(2).tolist() for step in fields["gain_steps"].items()]
        if any(gain <= 0.0 for _, gain in steps):
            fields["gain_steps"].fail("each entry is [instant, gain], with a gain above 0; correct it.")
        chosen["gain_steps"] = tuple(map(tuple, steps))
    if "frozen" in fields:
        chosen["frozen"] = intervals(fields["frozen"])
    if "robot_part" in fields:
        chosen["robot_part"] = share(fields["robot_part"])
    return ImageFaults(**chosen)


def _block(value: YamlValue) -> Obstacle:
    fields = value.record(("center", "size"), ("yaw_deg", "ramp"))
    x, y = fields["center"].vector(2).tolist()
    yaw = np.deg2rad(fields["yaw_deg"].number()) if "yaw_deg" in fields else 0.0
    return Obstacle((x, y), triple(fields["size"]), float(yaw), fields["ramp"].boolean() if "ramp" in fields else False)


def _motion(value: YamlValue, folder: Path) -> Drive:
    fields = value.record(("kind",), ("axis_imu", "path", "sideslip_deg", "seed"))
    chosen: dict[str, Any] = {"kind": fields["kind"].choice("motion", get_args(DriveKind))}
    if "axis_imu" in fields:
        chosen["axis_imu"] = tuple(fields["axis_imu"].vector(3).tolist())
        if not any(chosen["axis_imu"]):
            fields["axis_imu"].fail("must not be zero; give the direction of the axis.")
    if "path" in fields:
        chosen["path"] = folder / fields["path"].text()
    if "sideslip_deg" in fields:
        chosen["sideslip_deg"] = at_least(fields["sideslip_deg"], 0.0)
    if "seed" in fields:
        chosen["seed"] = fields["seed"].whole(0)
    return _construct(value, Drive, **chosen)


def _board(value: YamlValue) -> dict[str, Any]:
    """The fields of `Scenario` for the target and its pose, by name."""
    fields = value.entries()
    if "type" not in fields:
        value.fail(f"type is missing; add type: {', type: '.join(TARGETS)}.")
    kind = TARGETS[fields["type"].choice("target type", tuple(TARGETS))]
    parameters = [f for f in dataclasses.fields(kind) if f.init and f.name != "size_sigma"]
    required = tuple(f.name for f in parameters if f.default is dataclasses.MISSING)
    optional = tuple(f.name for f in parameters if f.name not in required)
    values = value.record(("type", "T_world_board", *required), optional)
    types = get_type_hints(kind)
    chosen = {f.name: _of_type(values[f.name], types[f.name]) for f in parameters if f.name in values}
    return {"target": _construct(value, kind, **chosen), "T_world_board": pose(values["T_world_board"])}


def _of_type(value: YamlValue, kind: type) -> Any:
    if kind is bool:
        return value.boolean()
    if kind is str:
        return value.text()
    return value.whole(0) if kind is int else value.positive()


def _features(value: YamlValue) -> Features:
    fields = value.record((), ("count", "persistent", "longest_track", "per_image", "range", "seed", "relief"))
    least = {"count": 1, "persistent": 0, "per_image": 1, "seed": 0}
    chosen: dict[str, Any] = {key: fields[key].whole(n) for key, n in least.items() if key in fields}
    named = {"longest_track": "longest_track_s", "range": "range_m"}
    chosen |= {field: fields[key].positive() for key, field in named.items() if key in fields}
    if "relief" in fields:
        chosen["relief_m"] = at_least(fields["relief"], 0.0)
    features = Features(**chosen)
    if features.persistent > features.count:
        value.fail(f"{features.persistent} persistent points are more than all {features.count}; lower persistent.")
    return features


# Scenario with tags on two walls and the floor of a room's corner, and a handheld rig in front of them.

_TAGS = Markers("tag36h11", 0.16, tuple(range(40, 76, 3)))
_GRID = AprilGrid(3, 3, 0.1, 0.3)  # ids 0 to 8
# Rotations R_world_surface: columns are x, y and normal of a surface. Walls are the planes x = 0 and y = 0; the floor
# is z = 0.
_WALLS_AND_FLOOR = np.array([[(0, 0, 1), (1, 0, 0), (0, 1, 0)], [(-1, 0, 0), (0, 0, 1), (0, 1, 0)], np.eye(3)])
# x, y of the middle of each tag on its surface [m], and its counter-clockwise rotation [deg].
_PLACES = (
    ((0.20, 0.70, 4.0), (0.50, 0.30, 90.0), (0.45, 0.95, -12.0), (0.95, 1.05, 0.0)),
    ((-0.25, 0.40, -3.0), (-0.65, 0.30, 25.0), (-0.50, 0.85, 178.0), (-1.00, 0.65, 0.0)),
    ((0.30, 0.30, 45.0), (0.75, 0.25, 7.0), (0.25, 0.80, -80.0), (0.75, 0.70, 130.0)),
)
_GRID_PLACE = (1.00, 0.55, -15.0)  # on the first wall


def tag_map(duration_s: float = 20.0, noiseless: bool = False, with_grid: bool = False) -> Scenario:
    """The rig of `handheld`, moved by hand 1.7 m in front of a room's corner with twelve tags of 0.16 m. Each image
    shows at least 3 tags. with_grid: the target is a scene of these tags ("tags") and an AprilGrid ("grid")."""
    T_world_bodies = np.stack([_pose(_TAGS, i, *place) for i in range(3) for place in _PLACES[i]])
    target: Target = _TAGS
    if with_grid:
        target = Scene(("tags", "grid"), (_TAGS, _GRID))
        T_world_bodies = np.concatenate([T_world_bodies, _pose(_GRID, 0, *_GRID_PLACE)[None]])
    base = handheld(duration_s, noiseless=noiseless)
    motion = replace(base.motion, distance_m=1.7)
    return replace(base, target=target, motion=motion, T_world_board=_faced(), T_world_bodies=T_world_bodies)


def _pose(sheet: Target, surface: int, x: float, y: float, turn_deg: float) -> np.ndarray:
    """(4, 4) T_world_body of a sheet whose middle is at x, y of a surface [m], rotated in its plane counter-clockwise
    by turn_deg."""
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    T = np.eye(4)
    T[:3, :3] = _WALLS_AND_FLOOR[surface] @ [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    T[:3, 3] = _WALLS_AND_FLOOR[surface] @ [x, y, 0.0] - T[:3, :3] @ (0.5 * sheet.points.max(axis=0))
    return T


def _faced() -> np.ndarray:
    """(4, 4) pose in the world that the motion faces, near the room's corner; its z points into the room and up."""
    z = np.array([1.0, 1.0, 0.6]) / np.linalg.norm([1.0, 1.0, 0.6])
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3] = np.stack([x, np.cross(z, x), z, [0.35, 0.35, 0.4]], axis=1)
    return T

"""Pose sensors of the rig file, and back to plain data."""

from __future__ import annotations

from typing import Any

from icalib.base.yaml_nodes import YamlValue
from icalib.rig import PoseKind, PoseSensor
from icalib.rig.file.fields import (
    TABLE,
    axes_or_none,
    choice_or,
    groups_to_plain,
    layout_to_plain,
    parameter_fields,
    parameters,
    path_or,
    table_layout,
    topic_or_none,
)

_FIELDS = ("path", "topic", "kind", "level", "position_axes", "inverted", "frames", "scale_sigma")
_NOISE = ("rotation_noise", "position_noise")


def pose_sensor(name: str, value: YamlValue) -> PoseSensor:
    """Raises RigError naming file, line and field."""
    found = value.record(("type",), (*_FIELDS, *_NOISE, *TABLE, *parameter_fields(PoseSensor)))
    return PoseSensor(
        name=name,
        path=path_or(found, f"{name}/poses.csv"),
        kind=choice_or(found, "kind", PoseKind, PoseSensor.kind),
        position_axes=axes_or_none(found, "position_axes"),
        level=found["level"].boolean() if "level" in found else PoseSensor.level,
        topic=topic_or_none(found),
        rotation_noise=found["rotation_noise"].positive() if "rotation_noise" in found else None,
        position_noise=found["position_noise"].positive() if "position_noise" in found else None,
        inverted="inverted" in found and found["inverted"].boolean(),
        layout=table_layout(found),
        scale_sigma=_scale_sigma(found["scale_sigma"]) if "scale_sigma" in found else PoseSensor.scale_sigma,
        frames=_frames(found["frames"]) if "frames" in found else None,
        **parameters(found, PoseSensor.stated()),
    )


def pose_to_plain(sensor: PoseSensor) -> dict[str, Any]:
    """The fields that `pose_sensor` reads."""
    plain: dict[str, Any] = {"type": "pose", "path": sensor.path, "kind": sensor.kind, "level": sensor.level}
    plain["scale_sigma"] = sensor.scale_sigma
    plain |= layout_to_plain(sensor.layout)
    given = {name: getattr(sensor, name) for name in (*_NOISE, "topic")}
    axes, frames = sensor.position_axes, sensor.frames
    given |= {"inverted": sensor.inverted or None, "position_axes": None if axes is None else list(axes)}
    given["frames"] = None if frames is None else list(frames)
    return plain | {name: value for name, value in given.items() if value is not None} | groups_to_plain(sensor)


def _scale_sigma(value: YamlValue) -> float:
    if not 0.0 <= (sigma := value.number()) < 1.0:
        value.fail(f"is a share of all lengths between 0 (exact) and 1, but is {sigma:g}; write 0.001 for 0.1 %.")
    return sigma


def _frames(value: YamlValue) -> tuple[str, str]:
    """Parent and child."""
    names = [entry.text() for entry in value.items()]
    if len(names) != 2 or names[0].lstrip("/") == names[1].lstrip("/"):
        value.fail("must name two frames, the parent and the child, as in [base_link, tool0]; correct it.")
    return names[0], names[1]

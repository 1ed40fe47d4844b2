"""A camera: its parameters, and its fields in the rig file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.geometry.cameras import CAMERA_MODELS, camera_model
from icalib.sensors.fields import (
    TABLE,
    choice_or,
    groups_to_plain,
    layout_to_plain,
    parameter_fields,
    parameters,
    path_or,
    table_layout,
    topic_or_none,
)
from icalib.sensors.parameter import Parameter, ParameterSpec, check_sizes
from icalib.sensors.sensor import CLOCK_RATE, MOUNTED, PLAIN_TABLE, Lack, MountedSensor, Sensor, TableLayout

INTRINSICS = ParameterSpec(
    name="intrinsics",
    size=4,
    manifold="vector",
    unit="px",
    labels=("fx", "fy", "cx", "cy"),
    tolerance="pixel_tolerance",
    prior_sigma=15.0,
    by_images=True,
    motion="show the target at different distances, tilted, and in every part of the image",
    motion_without_target="move so that near and far points of the scene cross the whole image",
)
# Distortion of polynomial models; `Camera.specs` adapts size, labels, tolerance and prior to the camera model.
DISTORTION = ParameterSpec(
    name="distortion",
    size=4,
    manifold="vector",
    unit="",
    labels=("k1", "k2", "k3", "k4"),
    tolerance=1e-2,
    prior_sigma=0.3,
    by_images=True,
    motion="show the target in the corners of the image",
    motion_without_target="turn so that points of the scene pass through the corners of the image",
)
BLOOM = ParameterSpec(
    name="bloom",
    size=1,
    manifold="vector",
    unit="px",
    labels=("bloom",),
    tolerance=0.1,
    prior_sigma=1.0,
    is_auxiliary=True,
    meaning="dark edges of the target shifted outwards by blur and the camera's response",
    by_images=True,
    motion="show the target from more distances",
)
# Time from the exposure of the first row of a rolling shutter to that of the row after the last: that of a row is late
# by readout (row / height - 1/2). Data sheets state 5 to 33 ms.
READOUT = ParameterSpec(
    name="readout",
    size=1,
    manifold="vector",
    unit="s",
    labels=("readout",),
    tolerance="time_tolerance_s",
    prior_sigma=0.02,
    is_effect=True,
    starts_at_zero=True,
    largest=0.5,
    meaning="time from the first row of an image to the one after the last",
    motion="turn the rig faster, with points in all rows of the image",
)
LENS = (INTRINSICS.name, DISTORTION.name)  # parameter groups of the camera model
TRACK_IMAGES = "images"  # value of `tracks`: feature tracks are found in the images
Rolling = Literal["rows", "columns"]  # what a rolling shutter exposes one after the other


class Shutter(NamedTuple):
    """A rolling shutter. axis: image axis along which it moves, 0 for columns and 1 for rows; size: their number."""

    axis: int
    size: int

    def phase(self, uv: np.ndarray) -> np.ndarray:
        """(n,) times of image points uv (n, 2) px after that of the middle of the image, in readout times."""
        return (uv[:, self.axis] + 0.5) / self.size - 0.5


@dataclass(frozen=True)
class Camera(MountedSensor):
    """One camera of the rig file. Intrinsics are (fx, fy, cx, cy) in pixels, distortion the coefficients of `model`.

    path: table of corners; resolution: (width, height) px. rolling: what its shutter exposes one after the other, with
    the parameter `readout` [s]; None for a global shutter, which has no such parameter."""

    sensor_type: ClassVar[str] = "camera"
    noun: ClassVar[str] = "camera"
    readings: ClassVar[str] = "images"
    gives_motion: ClassVar[bool] = True
    sees_target: ClassVar[bool] = True
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (*MOUNTED, CLOCK_RATE, INTRINSICS, DISTORTION, BLOOM, READOUT)
    lens: ClassVar[tuple[str, ...]] = LENS
    may_change: ClassVar[tuple[tuple[str, ...], ...]] = (*MountedSensor.may_change, (INTRINSICS.name,))

    path: str
    model: str
    resolution: tuple[int, int]
    corner_noise_px: float | None = None  # standard deviation per axis; None: estimated from residuals
    intrinsics: Parameter = Parameter()
    distortion: Parameter = Parameter()
    bloom: Parameter = Parameter()
    readout: Parameter = Parameter()
    rolling: Rolling | None = None
    topic: str | None = None  # topic of its images; None: the topic with the camera's name, or the only image topic
    tracks: str | None = None  # path of a table of feature tracks, or TRACK_IMAGES
    track_noise_px: float | None = None  # standard deviation per axis; None: estimated from residuals
    layout: TableLayout = PLAIN_TABLE  # columns of its table of tracks, or of corners if it has no tracks

    def __post_init__(self) -> None:
        known = self.model in CAMERA_MODELS  # other code raises the error for an unknown model
        check_sizes(self, self.specs() if known else MOUNTED)

    def specs(self) -> tuple[ParameterSpec, ...]:
        """See `Sensor`. Size, labels, tolerance and prior of distortion follow from the camera model."""
        model = camera_model(self.model)
        names, scale = model.parameter_names[len(INTRINSICS.labels) :], model.distortion_scale
        assert isinstance(DISTORTION.tolerance, float)
        distortion = replace(
            DISTORTION,
            size=len(names),
            labels=names,
            tolerance=scale * DISTORTION.tolerance,
            prior_sigma=scale * DISTORTION.prior_sigma,
        )
        return (*MOUNTED, CLOCK_RATE, INTRINSICS, distortion, BLOOM, *((READOUT,) if self.rolling else ()))

    def with_effects(self) -> Camera:
        """See `Sensor`: a rolling shutter."""
        return self if self.rolling else replace(self, rolling="rows", readout=Parameter("fixed"))

    @property
    def shutter(self) -> Shutter | None:
        """Its rolling shutter; None for a global shutter."""
        axis = 0 if self.rolling == "columns" else 1
        return Shutter(axis, self.resolution[axis]) if self.rolling else None

    @property
    def tracks_images(self) -> bool:
        """Whether feature tracks are found in the images, not read from a table."""
        return self.tracks == TRACK_IMAGES

    @classmethod
    def parse(cls, name: str, value: YamlValue) -> Camera:
        groups_of_all = (name for name in parameter_fields(cls) if name != READOUT.name)
        options = ("path", "topic", "corner_noise", "tracks", "track_noise", "shutter", *TABLE, *groups_of_all)
        fields = value.record(("type", "model", "resolution"), options)
        rolling = _rolling(fields)
        model = fields["model"].choice("camera model", tuple(CAMERA_MODELS))
        groups = parameters(fields, cls(name, "", model, (0, 0), rolling=rolling).specs())
        _refuse_negative_focal_length(fields, groups)
        return cls(
            name=name,
            path=path_or(fields, f"{name}/corners.csv"),
            model=model,
            resolution=_resolution(fields["resolution"]),
            corner_noise_px=fields["corner_noise"].positive() if "corner_noise" in fields else None,
            topic=topic_or_none(fields),
            tracks=fields["tracks"].text() if "tracks" in fields else None,
            track_noise_px=fields["track_noise"].positive() if "track_noise" in fields else None,
            rolling=rolling,
            layout=table_layout(fields),
            **groups,
        )

    def plain(self) -> dict[str, Any]:
        plain: dict[str, Any] = {"type": "camera", "path": self.path, "model": self.model}
        plain["resolution"] = list(self.resolution)
        if self.topic is not None:
            plain["topic"] = self.topic
        if self.corner_noise_px is not None:
            plain["corner_noise"] = self.corner_noise_px
        if self.tracks is not None:
            plain["tracks"] = self.tracks
        if self.track_noise_px is not None:
            plain["track_noise"] = self.track_noise_px
        groups = groups_to_plain(self)
        readout = groups.pop(READOUT.name)
        if self.rolling is not None:
            plain["shutter"] = {"rolling": self.rolling, READOUT.name: readout}
        return plain | layout_to_plain(self.layout) | groups

    def gives_motion_without_imu(self, has_target: bool) -> bool:
        return has_target

    @property
    def tracks_points(self) -> bool:
        return self.tracks is not None

    def lacks(self, sensors: Mapping[str, Sensor], has_target: bool) -> Iterator[Lack]:
        yield from super().lacks(sensors, has_target)
        blind = [s.name for s in sensors.values() if isinstance(s, Camera) and not s.tracks_points]
        if not has_target and blind:
            yield Lack(
                (),
                "target is missing; add target, targets for several by name, or tracks (images, or a table of "
                f"tracks) of {' and '.join(blind)}.",
            )


def _rolling(fields: dict[str, YamlValue]) -> Rolling | None:
    """What the rolling shutter of `shutter` exposes one after the other; None without this field. The readout time
    moves to `fields`, beside the other parameters."""
    if "shutter" not in fields:
        return None
    shutter = fields["shutter"].record(("rolling",), (READOUT.name,))
    fields |= {name: shutter[name] for name in (READOUT.name,) if name in shutter}
    return choice_or(shutter, "rolling", Rolling, None)


def _refuse_negative_focal_length(fields: dict[str, YamlValue], groups: dict[str, Parameter]) -> None:
    value = groups["intrinsics"].value if "intrinsics" in groups else None
    if value is not None and (value[:2] <= 0).any():
        fields["intrinsics"].fail("fx and fy of [fx, fy, cx, cy] must be above 0 px; correct them.")


def _resolution(value: YamlValue) -> tuple[int, int]:
    sides = value.items()
    if len(sides) != 2:
        value.fail(f"must be [width, height] in pixels, but has {len(sides)} entries.")
    return sides[0].whole(1), sides[1].whole(1)

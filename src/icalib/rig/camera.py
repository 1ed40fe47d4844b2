"""A camera: its lens, its corners and its feature tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from icalib.geometry.cameras import CAMERA_MODELS
from icalib.rig.parameter import Parameter
from icalib.rig.parameter_spec import ParameterSpec
from icalib.rig.sensor import MOUNTED, PLAIN_TABLE, Sensor, TableLayout

LENS = ("intrinsics", "distortion")  # the groups that are the parameters of its model
TRACK_IMAGES = "images"  # `tracks` of a camera whose feature tracks are found in its images


@dataclass(frozen=True)
class Camera(Sensor):
    """One camera. Intrinsics are (fx, fy, cx, cy) in pixels, distortion the model's coefficients."""

    sensor_type: ClassVar[str] = "camera"
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (
        *MOUNTED,
        ParameterSpec(
            name="intrinsics",
            size=4,
            manifold="vector",
            unit="px",
            labels=("fx", "fy", "cx", "cy"),
            tolerance="pixel_tolerance",
            prior_sigma=15.0,
            motion="show the target at different distances, tilted, and in every part of the image",
            motion_without_target="move so that near and far points of the scene cross the whole image",
        ),
        # Of a polynomial; `specs` has those of the camera's own model.
        ParameterSpec(
            name="distortion",
            size=4,
            manifold="vector",
            unit="",
            labels=("k1", "k2", "k3", "k4"),
            tolerance=1e-2,
            prior_sigma=0.3,
            motion="show the target in the corners of the image",
            motion_without_target="turn so that points of the scene pass through the corners of the image",
        ),
        ParameterSpec(
            name="bloom",
            size=1,
            manifold="vector",
            unit="px",
            labels=("bloom",),
            tolerance=0.1,
            prior_sigma=1.0,
            is_auxiliary=True,
            motion="show the target from more distances",
        ),
    )

    path: str
    model: str
    resolution: tuple[int, int]
    corner_noise_px: float | None = None  # None: estimated from the residuals
    rotation: Parameter = Parameter()
    translation: Parameter = Parameter()
    time_offset: Parameter = Parameter()
    clock_restarts: bool = False  # from recording to recording: each has a time offset of its own
    intrinsics: Parameter = Parameter()
    distortion: Parameter = Parameter()
    bloom: Parameter = Parameter()
    topic: str | None = None  # of its images; None: the one with the camera's name, or the only one
    tracks: str | None = None  # path of a table of feature tracks, or TRACK_IMAGES
    track_noise_px: float | None = None  # None: estimated from the residuals
    layout: TableLayout = PLAIN_TABLE  # of its table of tracks, or without one of corners

    def specs(self) -> tuple[ParameterSpec, ...]:
        """As in `Sensor`; of an unknown model, which is named where it is used, without distortion."""
        return tuple(spec for own in self.parameters if (spec := self._of_its_model(own)) is not None)

    def _of_its_model(self, spec: ParameterSpec) -> ParameterSpec | None:
        if spec.name != "distortion":
            return spec
        model = CAMERA_MODELS.get(self.model)
        if model is None:
            return None
        names, scale = model.parameter_names[4:], model.distortion_scale
        assert isinstance(spec.tolerance, float)
        return replace(
            spec, size=len(names), labels=names, tolerance=scale * spec.tolerance, prior_sigma=scale * spec.prior_sigma
        )

    @property
    def tracks_images(self) -> bool:
        """Whether its feature tracks are found in its images."""
        return self.tracks == TRACK_IMAGES

"""A camera: its lens, its corners and its feature tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from icalib.geometry.cameras import CAMERA_MODELS, camera_model
from icalib.rig.parameter import Parameter, check_sizes
from icalib.rig.parameter_spec import ParameterSpec
from icalib.rig.sensor import MOUNTED, PLAIN_TABLE, Sensor, TableLayout

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
# Of a polynomial; `specs` has those of the camera's own model.
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
LENS = (INTRINSICS.name, DISTORTION.name)  # the groups that are the parameters of its model
TRACK_IMAGES = "images"  # `tracks` of a camera whose feature tracks are found in its images


@dataclass(frozen=True)
class Camera(Sensor):
    """One camera. Intrinsics are (fx, fy, cx, cy) in pixels, distortion the model's coefficients."""

    sensor_type: ClassVar[str] = "camera"
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (*MOUNTED, INTRINSICS, DISTORTION, BLOOM)

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

    def __post_init__(self) -> None:
        known = self.model in CAMERA_MODELS  # an unknown one is named where it is used
        check_sizes(self, self.specs() if known else MOUNTED)

    def specs(self) -> tuple[ParameterSpec, ...]:
        """As in `Sensor`, distortion as of the camera's model."""
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
        return (*MOUNTED, INTRINSICS, distortion, BLOOM)

    @property
    def tracks_images(self) -> bool:
        """Whether its feature tracks are found in its images."""
        return self.tracks == TRACK_IMAGES

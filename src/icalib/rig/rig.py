"""What is on the robot and what is to be calibrated: the rig, as frozen dataclasses."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from icalib.errors import RigError
from icalib.geometry.cameras import CAMERA_MODELS
from icalib.geometry.targets import NoTarget, Target
from icalib.rig.imu_classes import FREE, IMU_CLASSES, N_INTRINSICS, ImuNoise, class_imperfections, class_of_noise
from icalib.rig.parameter import Parameter, check_fields, check_sizes

TimeUnit = Literal["s", "ms", "us", "ns"]
LENS = ("intrinsics", "distortion")  # the groups of a camera that are the parameters of its model


@dataclass(frozen=True)
class TableLayout:
    """How a sensor's table is written. columns: names in its header, or numbers from 1 on, in icalib's order; empty:
    told by the header, or in that order. time_unit: of its stamps; None: told by their rate."""

    columns: tuple[str, ...] = ()
    time_unit: TimeUnit | None = None


PLAIN_TABLE = TableLayout()


@dataclass(frozen=True)
class TwoSources:
    """Topics or tables of an IMU whose gyroscope and accelerometer report apart."""

    gyro: str
    accel: str


AccelUnit = Literal["m/s^2", "g"]
GyroUnit = Literal["rad/s", "deg/s"]
BY_CLASS = Parameter("free")  # IMU intrinsics of which nothing is said; `free()` is another
_CLASS_PRIORS = {n: Parameter("prior", np.zeros(N_INTRINSICS), class_imperfections(n).sigma) for n in IMU_CLASSES}
Axes = tuple[str, str, str]  # the columns that become x, y, z, each with its sign: ("x", "-y", "-z")


@dataclass(frozen=True)
class ImuSensor:
    """The inertial sensor; its frame is the body frame. Units and axes: of the readings as they are recorded; None: SI
    units (g is recognised), and the axes as they are. assumed: there is none, but an assumption of smooth motion in
    its place (see `initialize.assumed_motion`). intrinsics (24,): see `motion.imu_model`. They always
    have a prior: by default that of the IMU's class about the ideal IMU, a broad one where they are free, about the
    guess. What is fixed without a value is the ideal IMU."""

    name: str
    path: str | TwoSources
    noise: ImuNoise
    intrinsics: Parameter = BY_CLASS
    topic: str | TwoSources | None = None  # in a bag; None: those with the sensor's name, or the only ones
    accel_unit: AccelUnit | None = None
    gyro_unit: GyroUnit | None = None
    accel_axes: Axes | None = None
    gyro_axes: Axes | None = None
    assumed: bool = False
    pose_keyframes_s: float = 0.02  # between keyframes that poses alone place
    layout: TableLayout = PLAIN_TABLE

    def __post_init__(self) -> None:
        check_sizes(self, {"intrinsics": N_INTRINSICS})
        if self.intrinsics is BY_CLASS:
            object.__setattr__(self, "intrinsics", _CLASS_PRIORS[class_of_noise(self.noise)])
        elif self.intrinsics.mode == "free":
            start = np.zeros(N_INTRINSICS) if self.intrinsics.value is None else self.intrinsics.value
            object.__setattr__(self, "intrinsics", Parameter("prior", start, FREE.sigma))


MOUNTED = {"translation": 3, "time_offset": 1}  # numbers of a sensor's extrinsics beside its rotation
TRACK_IMAGES = "images"  # `tracks` of a camera whose feature tracks are found in its images


@dataclass(frozen=True)
class Camera:
    """One camera. Intrinsics are (fx, fy, cx, cy) in pixels, distortion the model's coefficients."""

    name: str
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
        model = CAMERA_MODELS.get(self.model)  # an unknown one is named where it is used
        distortion = {} if model is None else {"distortion": len(model.parameter_names) - 4}
        check_sizes(self, MOUNTED | {"intrinsics": 4, "bloom": 1} | distortion)

    @property
    def tracks_images(self) -> bool:
        """Whether its feature tracks are found in its images."""
        return self.tracks == TRACK_IMAGES


PointTime = Literal["auto", "start", "end", "azimuth", "snapshot"]


@dataclass(frozen=True)
class Lidar:
    """One LiDAR. Points nearer than min_range_m or farther than max_range_m are left out.

    point_time: what a point's time is counted from; see `data.messages.point_times`. point_time_field, point_time_unit:
    where the time of a point stands, and in what unit; None: told from the data.
    """

    name: str
    path: str
    range_noise_m: float | None = None  # along the beam; None: estimated from the residuals
    rotation: Parameter = Parameter()
    translation: Parameter = Parameter()
    time_offset: Parameter = Parameter()
    clock_restarts: bool = False  # from recording to recording: each has a time offset of its own
    min_range_m: float = 0.5
    max_range_m: float = 100.0
    point_time: PointTime = "auto"
    topic: str | None = None  # of its clouds; None: the one with the LiDAR's name, or the only one
    point_time_field: str | None = None
    point_time_unit: TimeUnit | None = None

    def __post_init__(self) -> None:
        check_sizes(self, MOUNTED)


WheelFactor = Literal["increments", "relative-poses"]
WheelMeasure = Literal["rates", "angles", "ticks", "poses", "twist"]
WheelDrive = Literal["differential", "skid-steer", "ackermann"]
RateUnit = Literal["rad/s", "deg/s", "rpm"]
RATE_UNITS: dict[RateUnit, float] = {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0}  # in rad/s
WheelKind = Literal["pair", "steered", "twist"]  # what the two columns of a `WheelStream` are

# The groups of each kind of wheels, with how many numbers they have.
DRIVE_SIZES: dict[WheelKind, dict[str, int]] = {
    "pair": {"radii": 2, "baseline": 1},
    "steered": {"radius": 1, "wheelbase": 1, "steering_offset": 1},
    "twist": {"scales": 2},
}


GroundPlane = Literal["floor", "level"]


@dataclass(frozen=True)
class Ground:
    """What wheels stand on: the floor that LiDARs see, or a plane as level as the horizon through the world's origin.

    tilt_noise: of the wheels' frame on the plane, at each node, about each axis; None: it may be tilted anyhow. height:
    of the frame's origin over the plane, with height_sigma, the same error all the time; None: it is not known.
    bump_noise: of the height at each node.
    """

    plane: GroundPlane
    tilt_noise: float | None = None  # rad
    height: float = 0.0  # m
    height_sigma: float | None = None  # m
    bump_noise: float = 3e-3  # m


@dataclass(frozen=True)
class Wheels:
    """What rolls on the ground. Its frame has x forward, y to the left, z up, its origin midway between the wheels of
    the axle that is not steered.

    drive: differential, two driven wheels of one axle; skid-steer, two pairs of which each turns alike; ackermann, the
    front wheels steer. measures: rates [rad/s], angles turned [rad], counts of encoders (ticks), relative planar poses
    (tables only), or twist, forward speed [m/s] and yaw rate [rad/s]. sampling: of rates and twist; see `WheelStream`.
    Densities: of each wheel's angle, of speed and yaw rate, of the steering angle, and of slip.
    """

    name: str
    path: str
    drive: WheelDrive = "differential"
    rotation: Parameter = Parameter()
    translation: Parameter = Parameter()
    time_offset: Parameter = Parameter()
    clock_restarts: bool = False  # from recording to recording: each has a time offset of its own
    radii: Parameter = Parameter()  # (2,) left, right [m]
    baseline: Parameter = Parameter()  # (1,) between the wheels [m]; of skid-steer the effective one
    radius: Parameter = Parameter()  # (1,) of the driven wheel of ackermann [m]
    wheelbase: Parameter = Parameter()  # (1,) from rear to front axle [m]
    steering_offset: Parameter = Parameter()  # (1,) what to add to the steering angle [rad]
    scales: Parameter = Parameter()  # (2,) what to multiply speed and yaw rate by
    wheel_noise: float = 0.03  # rad/sqrt(s): of rates at 70 Hz 0.25 rad/s each, as simulated wheels have it
    speed_noise: float = 2e-3  # m/sqrt(s)
    yaw_noise: float = 1e-2  # rad/sqrt(s)
    steering_noise: float = 1e-3  # rad/sqrt(Hz): of angles at 70 Hz half a degree each
    lateral_slip: float = 5e-3  # m/sqrt(s)
    vertical_slip: float = 5e-3  # m/sqrt(s), off the ground
    factor: WheelFactor = "increments"  # relative-poses: the paper's (27)
    measures: WheelMeasure = "rates"
    sampling: Literal["interval-mean", "instantaneous"] = "interval-mean"
    counts_per_turn: float | None = None  # of ticks, for one turn of the wheel
    signs: tuple[int, ...] | None = None  # 1 or -1 of each column of its table, or each joint; None: all 1
    rate_unit: RateUnit = "rad/s"  # of rates
    angle_range: float | None = None  # angles [rad] start anew after so much; None: never, or where it is plain
    counter_size: int | None = None  # the counters go back to zero after so many ticks; None: never
    topic: str | None = None  # of its messages; None: the one with the wheels' name, or the only one
    joints: tuple[str, ...] | None = None  # in JointState; None: told by "left" and "right" in the names
    ground: Ground | None = None
    layout: TableLayout = PLAIN_TABLE

    def __post_init__(self) -> None:
        check_sizes(self, MOUNTED | {group: n for sizes in DRIVE_SIZES.values() for group, n in sizes.items()})

    @property
    def ground_height(self) -> Parameter:
        """What the height over the ground starts from, where it is estimated."""
        return Parameter("free", np.array([0.0 if self.ground is None else self.ground.height]))

    @property
    def kind(self) -> WheelKind:
        """Which parameters it has: see `DRIVE_SIZES`."""
        if self.measures == "twist":
            return "twist"
        return "steered" if self.drive == "ackermann" else "pair"

    @property
    def sizes(self) -> dict[str, int]:
        """Its groups beside pose and clock that the rig file treats, with how many numbers they have."""
        return DRIVE_SIZES[self.kind]

    @property
    def knows_height(self) -> bool:
        """Whether the group ground_height (1,) [m] is estimated."""
        return self.ground is not None and self.ground.height_sigma is not None


PoseKind = Literal["absolute", "relative"]


@dataclass(frozen=True)
class PoseSensor:
    """Something that says where it is: motion capture, or another program's odometry.

    absolute: in a frame that stands still, whose place in the world is estimated; noise is white, rad and m. relative:
    only the way from each pose to the next counts; noise is a random walk, rad/sqrt(s) and m/sqrt(s). level: z of its
    frame points up, as far as the motion does not say otherwise; used where neither an IMU nor a target shows it.
    """

    name: str
    path: str
    kind: PoseKind = "absolute"
    rotation_noise: float | None = None  # of each axis; None: estimated from the residuals
    position_noise: float | None = None
    level: bool = True
    position_axes: Axes | None = None  # of positions as recorded, in the order and with the signs of rotations
    rotation: Parameter = Parameter()
    translation: Parameter = Parameter()
    time_offset: Parameter = Parameter()
    clock_restarts: bool = False  # from recording to recording: each has a time offset of its own
    topic: str | None = None  # of its poses; None: the one with the sensor's name, or the only one
    layout: TableLayout = PLAIN_TABLE
    inverted: bool = False  # what is recorded is T_sensor_frame
    frames: tuple[str, str] | None = None  # parent and child in a topic of transforms; None: it is not one
    scale_sigma: float = 0.001  # of all its lengths, relative: true over reported ones is about 1; 0: exact

    def __post_init__(self) -> None:
        check_sizes(self, MOUNTED)


Scheme = Literal["inertial", "pose", "kinematic"]
Loss = Literal["none", "huber", "cauchy"]
Keyframes = Literal["every-image", "first-camera"]


@dataclass(frozen=True)
class Settings:
    """How the estimate is made; every field has a default that just works."""

    scheme: Scheme = "inertial"  # where a sensor was between nodes
    keyframes: Keyframes = "every-image"  # images that have a keyframe of their own; the paper: the first camera's
    loss: Loss = "huber"  # robust loss on corners
    loss_scale: float = 2.5  # in standard deviations, where the loss starts to bend
    outlier_std: float = 4.0  # drop corners this many standard deviations beyond their image's mean error; 0: none
    outlier_min_px: float = 1.0  # but never one with a smaller error
    bloom: bool = True  # corners pulled towards their tag's centre, one size a camera
    board_shape: bool = True  # the target is not flat: estimate how it bends
    blur_noise: bool = True  # corners of fast images weigh less
    common_error: bool = False  # corners of one image share an error: a shift, its size estimated
    cache_corners: bool = True  # keep detected corners in the user's cache folder for the next run
    segments: int = 8  # segments of the block jackknife (empirical factor), 0: none
    max_gap_s: float = 0.5  # IMU gaps up to this are bridged; longer ones split the recording
    keyframe_spacing_s: float = 0.05  # largest distance of neighbouring keyframes
    # Points that cameras follow lie on the planes that LiDARs see, to within this; 0: nothing is said of that.
    points_on_planes_m: float = 0.0
    # What is known to better than these is determined.
    rotation_tolerance_deg: float = 0.1
    translation_tolerance_m: float = 5e-3
    time_tolerance_s: float = 1e-3
    pixel_tolerance: float = 1.0  # of fx, fy, cx, cy


@dataclass(frozen=True)
class Rig:
    """The whole robot. Without an IMU the frame of the first camera that sees a target is the body frame, or that of
    the first pose sensor. If cameras are all there is, time stands still: images taken at the same stamp are taken
    together, nothing ties one instant to the next; else the motion is assumed to be smooth. There may be no camera
    beside a pose sensor, or beside an IMU and a LiDAR."""

    imu: ImuSensor | None
    cameras: tuple[Camera, ...]
    target: Target = NoTarget()
    gravity: float = 9.81  # m/s^2
    settings: Settings = Settings()
    path: Path | None = None
    lidars: tuple[Lidar, ...] = ()
    wheels: tuple[Wheels, ...] = ()
    poses: tuple[PoseSensor, ...] = ()

    @property
    def has_target(self) -> bool:
        """Whether there is a target; else all cameras have feature tracks."""
        return len(self.target.bodies) > 0

    @property
    def blooms(self) -> bool:
        """Whether bloom is estimated: it is asked for, and the target's corners can be pulled."""
        return self.settings.bloom and self.target.blooms

    @property
    def body(self) -> str:
        """Name of the sensor whose frame is the body frame."""
        return self.first_seeing if self.imu is None else self.imu.name

    @property
    def first_seeing(self) -> str:
        """Name of the sensor that is the body where there is no IMU."""
        return (*self.poses, *self.cameras)[0].name if self.moves_by_poses else (*self.cameras, *self.poses)[0].name

    @property
    def moves_by_poses(self) -> bool:
        """Whether without an IMU the first pose sensor shows the motion: no camera sees a target."""
        return bool(self.poses) and not (self.cameras and self.has_target)

    @property
    def cameras_alone(self) -> bool:
        """Whether there are cameras and no other sensor."""
        return self.imu is None and not (self.lidars or self.wheels or self.poses)

    @property
    def assumes_motion(self) -> bool:
        """Whether an assumption stands in for the IMU."""
        return self.imu is not None and self.imu.assumed

    def with_(self, part: str = "", /, **fields: Any) -> Rig:
        """The same rig with some `fields` changed: of the sensor called `part`, of "settings", or of the rig itself.

        For example rig.with_("cam0", intrinsics=icalib.fixed([458, 457, 367, 248])). Raises RigError where there is
        no such sensor or field, or a value is of another kind.
        """
        places = {"": (None, self), "settings": ("settings", self.settings)}
        imus = {} if self.imu is None else {self.imu.name: ("imu", self.imu)}
        kinds = ("cameras", "lidars", "wheels", "poses")
        places |= imus | {s.name: (kind, s) for kind in kinds for s in getattr(self, kind)}
        if part not in places:
            raise RigError(f"there is no sensor {part}; the rig has {', '.join(filter(None, places))}.")
        kind, old = places[part]
        check_fields(part or "the rig", old, fields)
        new = dataclasses.replace(old, **fields)
        if kind is None:
            return new
        same = getattr(self, kind)
        changed = tuple(new if s is old else s for s in same) if isinstance(same, tuple) else new
        return dataclasses.replace(self, **{kind: changed})

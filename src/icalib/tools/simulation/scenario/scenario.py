"""Description of a simulation, as frozen dataclasses: true rig, motion and all disturbances."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

import numpy as np

from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Target
from icalib.rig import ImuNoise
from icalib.sensors.camera.spec import BLOOM, DISTORTION, INTRINSICS
from icalib.tools.simulation.scenario.fields import pose_from_rows
from icalib.tools.simulation.scenario.image_faults import ImageFaults
from icalib.tools.simulation.scenario.robot import Drive, Features
from icalib.tools.simulation.scenario.room import Room
from icalib.tools.simulation.scenario.sensor import SimSensor

Kind = TypeVar("Kind", bound=SimSensor)

ImuSampling = Literal["instantaneous", "low-pass", "interval-mean"]  # see `sensors.imu.ideal_readings`
MotionKind = Literal["handheld", "planar", "single_axis", "motionless"]
Interval = tuple[float, float]  # (start, end) in seconds on the IMU's clock, since its origin

MODELS: tuple[str, ...] = (
    "pinhole-radtan",
    "pinhole-equidistant",
    "eucm",
    "double-sphere",
    "omni-radtan",
    "pinhole-rational",
)
ADIS16448 = ImuNoise(1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3, source="data sheet of the ADIS16448")
GRAVITY_WORLD = np.array([0.0, 0.0, -9.81])  # m/s^2

_EUROC_T_IMU_CAM0 = (
    (0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975),
    (0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768),
    (-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949),
    (0.0, 0.0, 0.0, 1.0),
)
_EUROC_EPOCH_NS = 1_403_715_273_262_142_976  # a stamp of the data set, for clocks as long as real ones
_EUROC_T_IMU_CAM1 = (
    (0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556),
    (0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024),
    (-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038),
    (0.0, 0.0, 0.0, 1.0),
)


def _standing_board() -> np.ndarray:
    """(4, 4) T_world_board of an almost upright board: its y nearly up, the tags facing -y of the world, yawed by 25
    deg, leaning and rolled by a few degrees."""
    yaw, lean, roll = np.deg2rad([25.0, 6.0, 3.0])
    stand = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(lean), -np.sin(lean)], [0.0, np.sin(lean), np.cos(lean)]])
    in_plane = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    T = np.eye(4)
    T[:3, :3] = about_z @ about_x @ stand @ in_plane
    T[:3, 3] = [0.3, -0.2, 1.0]
    return T


@dataclass(frozen=True, eq=False)
class SimCamera:
    """A simulated camera, with its true parameters.

    Image i is taken at phase_s + i / rate_hz on the IMU's clock, and stamped by the camera's clock. Its stamp follows
    from t_imu = t_cam + time_offset_s, each since the origin of its clock. Stamps are rounded to ns, and the truth is
    evaluated at the rounded stamp. intrinsics: fx, fy, cx, cy [px]. bloom_px: edge bloom, which moves each corner in
    the image towards the centre of its tag. dropouts: there are no images in these intervals. Raises RigError for an
    unknown model.
    """

    name: str
    model: str
    resolution: tuple[int, int]
    intrinsics: tuple[float, ...]
    distortion: tuple[float, ...]
    T_imu_sensor: np.ndarray  # (4, 4)
    time_offset_s: float = 0.0
    rate_hz: float = 20.0
    phase_s: float = 0.0
    clock_origin_ns: int = 0
    jitter_s: float = 0.0  # instants shifted by uniform +-jitter_s, below half a period
    corner_noise_px: float = 0.2
    bloom_px: float = 0.0
    dropouts: tuple[Interval, ...] = ()

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise RigError(
                f"{self.name}: the simulator has no camera model {self.model!r}; available are {', '.join(MODELS)}."
            )

    def values(self) -> dict[str, np.ndarray]:
        """True values of its parameters by their names in the rig, except extrinsics and time offset."""
        return {
            INTRINSICS.name: np.array(self.intrinsics),
            DISTORTION.name: np.array(self.distortion),
            BLOOM.name: np.array([self.bloom_px]),
        }


@dataclass(frozen=True)
class HandheldMotion:
    """Motion of the rig in front of the board: sums of sinusoids about a pose `distance_m` in front of its centre.

    handheld: all axes. planar: yaw about the world's z, and translation along its x and y. single_axis: rotation about
    `axis_imu` only, translation along all axes. motionless: none. rotation_scale, translation_scale: factors on the
    amplitudes, which give about 1.1 rad/s and 4.7 m/s^2 RMS.
    """

    kind: MotionKind = "handheld"
    distance_m: float = 0.8
    rotation_scale: float = 1.0
    translation_scale: float = 1.0
    axis_imu: tuple[float, float, float] = (0.0, 1.0, 0.0)
    seed: int | None = None  # of the motion; None: the seed of the simulation


@dataclass(frozen=True, eq=False)
class Scenario:
    """All inputs of `simulate` but the seed.

    T_world_bodies (bodies, 4, 4): poses of the bodies of a target with several bodies; T_world_board is then only the
    pose that the motion faces. None: the target is one body, at T_world_board. Bodies do not hide each other.

    imu_intrinsics (24,), the scale-misalignment model: w_m = M_g w + A_g f + b_g, a_m = M_a C_a f + b_a, with w and f
    in the axes of the gyroscope, M_a - I and M_g - I lower triangular (xx, yx, yy, zx, zy, zz), C_a = Exp(rotation
    vector) from gyroscope to accelerometer axes, A_g row-major; in the order M_a, M_g, C_a, A_g. bow (3,) [m]: a, b, c
    of the shape z = a x^2 + b x y + c y^2 of a body that bends, with x and y from -1 to 1 over its extent. Corner noise
    has sigma^2 = corner_noise_px^2 + (blur_s * image speed)^2, with the RMS image speed of the corners of an image
    [px/s]. shift_px: sigma of a 2D shift that all corners of an image share. target_size: true over stated length of
    the target. outlier_fraction: of the corners, which are moved by up to +-outlier_px on each axis.

    Raises RigError if a body has no pose, or if motion, room and sensors are incompatible.
    """

    cameras: tuple[SimCamera, ...]
    target: Target = AprilGrid(6, 6, 0.088, 0.3)
    duration_s: float = 20.0
    motion: HandheldMotion | Drive = HandheldMotion()
    T_world_board: np.ndarray = field(default_factory=_standing_board)
    T_world_bodies: np.ndarray | None = None
    bow: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target_size: float = 1.0
    imu_rate_hz: float = 200.0
    imu_noise: ImuNoise = ADIS16448
    imu_noise_enabled: bool = True  # white noise and bias walk
    gyro_bias: tuple[float, float, float] = (-0.002, 0.021, 0.076)  # rad/s, at the first reading
    accel_bias: tuple[float, float, float] = (-0.03, 0.11, 0.08)  # m/s^2
    imu_intrinsics: np.ndarray = field(default_factory=lambda: np.zeros(24))
    imu_clock_origin_ns: int = 0
    imu_sampling: ImuSampling = "instantaneous"
    imu_jitter_s: float = 0.0  # readings taken at instants shifted by uniform +-imu_jitter_s, below half a period
    imu_gaps: tuple[Interval, ...] = ()  # readings inside are lost
    corner_noise_enabled: bool = True  # white, blur and shift
    blur_s: float = 0.0
    shift_px: float = 0.0
    outlier_fraction: float = 0.0
    outlier_px: float = 20.0
    board: bool = True  # whether the target stands in the scene
    room: Room | None = None
    features: Features | None = None  # on the room's surfaces; None: no tracks
    sensors: tuple[SimSensor, ...] = ()  # beside IMU and cameras
    image_faults: ImageFaults = ImageFaults()
    robot_noise_enabled: bool = True  # of tracks, and of `sensors`
    seed: int = 0  # default seed of the simulation

    def __post_init__(self) -> None:
        _check_robot(self)
        needed = (len(self.target.bodies), 4, 4)
        if (given := self.body_poses.shape) != needed:
            raise RigError(
                f"T_world_bodies has shape {given}, but the target's bodies need {needed}; give a pose of each."
            )

    @property
    def body_poses(self) -> np.ndarray:
        """(bodies, 4, 4) T_world_body."""
        return self.T_world_board[None] if self.T_world_bodies is None else self.T_world_bodies

    @property
    def mounted(self) -> tuple[SimCamera | SimSensor, ...]:
        """All sensors but the IMU."""
        return *self.cameras, *self.sensors

    def of(self, kind: type[Kind]) -> tuple[Kind, ...]:
        """The sensors of one kind, without cameras."""
        return tuple(sensor for sensor in self.sensors if isinstance(sensor, kind))

    def with_sensors(self, *sensors: SimSensor) -> Scenario:
        """The scenario with these `sensors`; they replace sensors of the same name."""
        named = {sensor.name: sensor for sensor in (*self.sensors, *sensors)}
        return replace(self, sensors=tuple(named.values()))


def _check_robot(scenario: Scenario) -> None:
    """Raises RigError if motion, room and sensors of a scenario are incompatible."""
    drive, room = (scenario.motion if isinstance(scenario.motion, Drive) else None), scenario.room
    if (drive or scenario.features) and room is None:
        raise RigError("drives and features need a room; give the scenario one.")
    if drive is not None and drive.kind == "ramps" and (room is None or room.hills is None):
        raise RigError("the motion ramps needs hills; give the room a slope.")
    if room and room.hills and drive is not None and drive.on_ground and drive.kind != "ramps":
        raise RigError(f"the motion {drive.kind} needs a flat floor; remove the slope from the room.")
    for sensor in scenario.sensors:
        sensor.check(room, drive)


def handheld(
    duration_s: float = 20.0,
    asynchronous: bool = False,
    imu: Literal["datasheet", "noisy"] = "datasheet",
    noiseless: bool = False,
) -> Scenario:
    """The EuRoC sensor unit (two radtan cameras at 20 Hz, ADIS16448 at 200 Hz), moved by hand in front of its
    AprilGrid.

    asynchronous: cam1 takes its images half a period after cam0. imu "noisy": ten times the data sheet's densities.
    noiseless: neither corners nor
    IMU have noise, and the IMU has 2000 Hz, at which interpolation between readings leaves 1e-8; `rig_for` still states
    the sigmas.
    """
    scale = {"datasheet": 1.0, "noisy": 10.0}[imu]
    return Scenario(
        _euroc_cameras(phase_s=0.025 if asynchronous else 0.0),
        duration_s=duration_s,
        imu_noise=replace(ADIS16448.scaled(scale), source="simulation"),
        imu_rate_hz=2000.0 if noiseless else 200.0,
        imu_noise_enabled=not noiseless,
        corner_noise_enabled=not noiseless,
        imu_clock_origin_ns=_EUROC_EPOCH_NS,
    )


def _euroc_cameras(phase_s: float) -> tuple[SimCamera, SimCamera]:
    """Both cameras of the EuRoC sensor unit; phase_s: delay of cam1's images after those of cam0 [s]."""
    cam0 = SimCamera(
        "cam0",
        "pinhole-radtan",
        (752, 480),
        (458.654, 457.296, 367.215, 248.375),
        (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
        pose_from_rows(_EUROC_T_IMU_CAM0),
        time_offset_s=0.0042,
        clock_origin_ns=_EUROC_EPOCH_NS,
    )
    cam1 = SimCamera(
        "cam1",
        "pinhole-radtan",
        (752, 480),
        (457.587, 456.134, 379.999, 255.238),
        (-0.28368365, 0.07451284, -0.00010473, -3.555907e-05),
        pose_from_rows(_EUROC_T_IMU_CAM1),
        time_offset_s=-0.0073,
        phase_s=phase_s,
        clock_origin_ns=_EUROC_EPOCH_NS,
    )
    return cam0, cam1

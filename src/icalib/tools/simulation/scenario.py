"""Description of a simulation: the rig, its motion, the room, the noise, and effects beyond the model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Target
from icalib.kinds import simulated_kinds
from icalib.rig import ImuNoise
from icalib.sensors.camera.spec import BLOOM, DISTORTION, INTRINSICS, READOUT, Rolling
from icalib.sensors.sensor import Sensor
from icalib.sensors.stream import Stream
from icalib.tools.simulation.output import BagWriter
from icalib.tools.simulation.room import Room, Texture, dead_leaves
from icalib.tools.simulation.trajectory import LEAD_S, Drive, Features, TrueTrajectory

# Base class of simulated sensors other than IMU and cameras; `kinds.py` lists those of all kinds.

BagEvent = tuple[int, Callable[[BagWriter], Any]]  # instant of reception on the IMU's clock [ns]; maker of the message


@dataclass(frozen=True, eq=False)
class SimScene:
    """The world that sensors measure. trajectory: of the IMU; imu_seconds (N,): instants of its readings on its clock
    since the origin; noisy: whether sensors have noise; sheets (n, 4, 3): faces of boards in the room, as `Room.faces`.
    """

    trajectory: TrueTrajectory
    imu_seconds: np.ndarray
    duration_s: float
    room: Room | None
    noisy: bool
    sheets: np.ndarray = field(default_factory=lambda: np.empty((0, 4, 3)))


class Report(NamedTuple):
    """Measurements of a sensor, and their truth (without noise), in a class of its kind."""

    stream: Stream
    truth: Any = None


@dataclass(frozen=True, eq=False)
class BagTopic:
    """The messages of one sensor. name: of the topic; message: their type; events: in order of reception."""

    name: str
    message: str
    events: Iterator[BagEvent]


@dataclass(frozen=True, eq=False)
class SimRecord:
    """How measurements are recorded. write_table: writes them to the sensor's folder, as a table with the path in
    `SimSensor.rig_entry`; topic: the messages that the sensor's driver would send, or a sentence if it has none."""

    write_table: Callable[[Path], None]
    topic: BagTopic | str


@dataclass(frozen=True, eq=False)
class TrueParameters:
    """values: by their names in the rig, except extrinsics and time offset; entries: what else truth.yaml says of the
    sensor, but for its type."""

    values: Mapping[str, np.ndarray] = field(default_factory=dict)
    entries: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class SimSensor(ABC):
    """A simulated sensor that is rigidly mounted to the IMU and has a separate clock.

    T_imu_sensor (4, 4): p_imu = T_imu_sensor p_sensor. Measurement i is taken at phase_s + i / rate_hz on the IMU's
    clock, and stamped by the sensor's clock, as images of `SimCamera`, by whose clock_rate_ppm it drifts.

    Class variables: sensor_type, as in the rig file; random_stream, number of the first sensor's random stream, at
    least 1000 apart from those of other kinds; measures, noun for its measurements in messages; rolls, whether its
    frame is the wheel frame of motions on the ground; effects, name in the section `effects` of a scenario file -> name
    of the field that it sets, and the reader of its value.
    """

    sensor_type: ClassVar[str]
    random_stream: ClassVar[int]
    measures: ClassVar[str] = "readings"
    rolls: ClassVar[bool] = False
    effects: ClassVar[dict[str, tuple[str, Callable[[YamlValue], Any]]]] = {}

    name: str
    T_imu_sensor: np.ndarray
    time_offset_s: float = 0.0
    clock_rate_ppm: float = field(default=0.0, kw_only=True)
    rate_hz: float = 10.0
    phase_s: float = 0.0
    clock_origin_ns: int = 0

    @classmethod
    @abstractmethod
    def parse(cls, name: str, value: YamlValue, start_ns: int) -> SimSensor:
        """The sensor from its section `value` of a scenario file; start_ns: origin of all clocks. Raises RigError
        naming file, line and field."""

    def check(self, room: Room | None, drive: Drive | None) -> None:  # noqa: B027 - most kinds need nothing
        """Raises RigError if the sensor cannot measure in this room, or on this motion (None: handheld)."""

    @property
    def points(self) -> int:
        """Number of points of one measurement; 0 for a sensor without points."""
        return 0

    def true_parameters(self) -> TrueParameters:
        return TrueParameters()

    @abstractmethod
    def report(self, scene: SimScene, seed: list[int], progress: Callable[[float], None]) -> Report:
        """Simulates the measurements; seed: of the sensor's random numbers. Raises RigError if there are fewer than two
        measurements."""

    @abstractmethod
    def rig_entry(self) -> Sensor:
        """The sensor as a user would write it in the rig, with the simulated noise and without known parameters."""

    @abstractmethod
    def record(self, stream: Any, offset_ns: int) -> SimRecord:
        """Table and messages of its measurements. offset_ns: to be added to the sensor's stamps to get the IMU's clock
        [ns]."""


# Refuses scenarios whose measurements do not fit in memory: the simulator keeps all of them.

# Limits for all sensors together. Each corresponds to about 1 GB with intermediate arrays; memory is proportional.
MOST_INSTANTS = 5_000_000  # readings, images and scans: an IMU at 200 Hz for 7 h
MOST_POINTS = 100_000_000  # corners, tracked points and points of scans: 16 rings of 1800 steps at 8 Hz for 7 min
_LARGEST_COUNT = 1e18  # larger counts are clipped, so that products stay finite


@dataclass(frozen=True)
class _Rate:
    """Amount of measurements of a sensor. rate_hz: measurements per second; count: points per measurement; instants,
    points: nouns for the two in messages."""

    name: str
    rate_hz: float
    instants: str
    count: int = 0
    points: str = "points"


def refuse_large(scenario: Scenario) -> None:
    """Raises RigError, naming the largest sensor, if all sensors together exceed `MOST_INSTANTS` or `MOST_POINTS`."""
    rates = list(_rates(scenario))
    instants = [min(r.rate_hz * scenario.duration_s, _LARGEST_COUNT) for r in rates]
    points = [n * r.count for n, r in zip(instants, rates, strict=True)]
    _refuse(instants, [(r.name, r.instants) for r in rates], "readings, images and scans", MOST_INSTANTS)
    _refuse(points, [(r.name, r.points) for r in rates], "corners and points", MOST_POINTS)


def _refuse(counts: list[float], names: list[tuple[str, str]], of_all: str, most: int) -> None:
    """Raises RigError if the sum of `counts` exceeds `most`. counts: of each sensor; names: its name, and the noun for
    what is counted; of_all: noun for all sensors."""
    total = sum(counts)
    if total <= most:
        return
    count, (name, what) = max(zip(counts, names, strict=True))
    if count > most:
        sentence = f"{name} would measure {_words(count)} {what}"
    else:
        sentence = f"the sensors would measure {_words(total)} {of_all} together, {name} {_words(count)} of them"
    raise RigError(f"{sentence}, and {most:,} are the most that are simulated; lower its rate, or the duration.")


def _words(count: float) -> str:
    """The count as text, with all digits below 1e9: rounded, counts near a limit would look equal to it."""
    return f"{ceil(count):,}" if count < 1e9 else f"{count:.2g}"


def _rates(scenario: Scenario) -> Iterator[_Rate]:
    yield _Rate("imu0", scenario.imu_rate_hz, "readings")
    corners = len(scenario.target.points) if scenario.board else 0
    tracked = scenario.features.per_image if scenario.features else 0
    for camera in scenario.cameras:
        yield _Rate(camera.name, camera.rate_hz, "images", corners + tracked, "corners and points")
    for sensor in scenario.sensors:
        yield _Rate(sensor.name, sensor.rate_hz, sensor.measures, sensor.points)


# Reads `effects` of a scenario file: errors of real sensors and targets. The format is in docs/simulation.md.

# Field of the IMU -> indices of its numbers in `Scenario.imu_intrinsics`.
_IMU = {
    "accel_scale": (0, 2, 5),
    "accel_misalignment": (1, 3, 4),
    "gyro_scale": (6, 8, 11),
    "gyro_misalignment": (7, 9, 10),
    "accel_rotation": (12, 13, 14),
    "g_sensitivity": tuple(range(15, 24)),
}
_LARGEST = 0.2  # limit of a relative error, which no usable sensor exceeds
_LEAST_CUTOFF_HZ = 1.0  # of a low-pass, which leaves hardly any motion below; readings are exact for motion to 7 Hz


def read_effects(value: YamlValue, sensors: Sequence[SimSensor]) -> dict[str, Any]:
    """The fields of `Scenario` that effects change, by name. value: the section; sensors: those of the scenario file.
    Raises RigError naming file, line and field."""
    of_kinds = {effect: kind for kind in simulated_kinds().values() for effect in kind.effects}
    fields, changed = value.record((), ("imu", "target_size", *of_kinds)), {}
    if "imu" in fields:
        changed |= _of_imu(fields["imu"])
    if "target_size" in fields:
        changed["target_size"] = true_ratio(fields["target_size"])
    for effect in of_kinds.keys() & fields.keys():
        sensors = _with_effect(fields[effect], sensors, of_kinds[effect], effect)
        changed["sensors"] = sensors
    return changed


def _with_effect(
    value: YamlValue, sensors: Sequence[SimSensor], kind: type[SimSensor], effect: str
) -> tuple[SimSensor, ...]:
    """The sensors, with the field of `effect` of those of `kind` set to what `value` gives for their names."""
    field, read = kind.effects[effect]
    given = value.record((), tuple(s.name for s in sensors if isinstance(s, kind)))
    by_name = {name: read(number) for name, number in given.items()}
    return tuple(replace(s, **{field: by_name[s.name]}) if s.name in by_name else s for s in sensors)


def _of_imu(value: YamlValue) -> dict[str, Any]:
    """The fields of `Scenario` that effects of the IMU change."""
    fields, intrinsics = value.record((), (*_IMU, "accel_delay", "cutoff")), np.zeros(24)
    for name, numbers in ((name, numbers) for name, numbers in fields.items() if name in _IMU):
        values = numbers.vector(len(_IMU[name]))
        if np.abs(values).max() > _LARGEST:
            numbers.fail(f"must be between {-_LARGEST} and {_LARGEST}: 0.01 is 1 %, or 10 mrad.")
        intrinsics[list(_IMU[name])] = values
    changed: dict[str, Any] = {"imu_intrinsics": intrinsics}
    if "accel_delay" in fields:
        changed["imu_accel_delay_s"] = limited(fields["accel_delay"], LEAD_S)
    if "cutoff" in fields:
        changed["imu_cutoff_hz"] = at_least(fields["cutoff"], _LEAST_CUTOFF_HZ)
    return changed


def limited(value: YamlValue, largest: float) -> float:
    """A number of at most this absolute value."""
    number = value.number()
    if abs(number) > largest:
        value.fail(f"must be between {-largest:g} and {largest:g}, but is {number:g}.")
    return number


def true_ratio(value: YamlValue) -> float:
    """A ratio of true to stated length."""
    ratio = value.number()
    if abs(ratio - 1.0) > _LARGEST:
        value.fail(f"is true over stated length, between {1.0 - _LARGEST} and {1.0 + _LARGEST}, but is {ratio:g}.")
    return ratio


# Disturbances of images: walking people, changes of gain, repeated images, parts of the robot in view, dirt.

_PART_TEXEL_M = 0.002  # width of a pixel on the part of the robot, as from 0.9 m at a focal length of 460 px
_DIRT_SIZE = (0.02, 0.06)  # range of the standard deviation of a spot, relative to the image's width
_DIRT_DARK = (0.4, 0.9)  # range of the fraction of light that is lost in the middle of a spot
_PART_STREAM, _DIRT_STREAM = 20_000, 20_001  # numbers of random streams


@dataclass(frozen=True)
class ImageFaults:
    """Disturbances of the images of a room, the same for all cameras. Instants are seconds on the IMU's clock since its
    origin.

    people: number of people who walk in front of the first camera, at 1.4 to 2.2 m; one covers about an eighth of an
    image of 80 deg. gain_steps: (instant, gain), from the instant on all light is multiplied by gain. frozen: (start,
    end), in which cameras repeat the image before. robot_part: fraction of the image, from the bottom, that a part of
    the robot hides. dirt: number of spots on the lens.
    """

    people: int = 0
    gain_steps: tuple[tuple[float, float], ...] = ()
    frozen: tuple[tuple[float, float], ...] = ()
    robot_part: float = 0.0
    dirt: int = 0

    def gain_at(self, seconds: float) -> float:
        past = [step for step in self.gain_steps if step[0] <= seconds]
        return max(past)[1] if past else 1.0


@dataclass(frozen=True, eq=False)
class CameraFaults:
    """Constant disturbances in the view of one camera. share (H, W): fraction of the light that passes the dirt; part
    (H, W): fraction of each pixel that the robot covers; texture (H, W): of the robot there, 0 to 1. None stands for no
    disturbance."""

    share: np.ndarray | None = None
    part: np.ndarray | None = None
    texture: np.ndarray | None = None

    def applied(self, grey: np.ndarray, black: float, white: float) -> np.ndarray:
        """grey (H, W) with the part of the robot and the dirt; black, white: greys of texture 0 and 1."""
        if self.part is not None and self.texture is not None:
            grey = grey + self.part * (black + (white - black) * self.texture - grey)
        return grey if self.share is None else grey * self.share


def faults_of(faults: ImageFaults, resolution: tuple[int, int], camera: int) -> CameraFaults:
    """The constant disturbances of camera number `camera`; resolution: (width, height) px."""
    width, height = resolution
    share = part = texture = None
    u, v = np.meshgrid(np.arange(width) / width, np.arange(height) / height)
    if faults.robot_part > 0.0:
        edge = 1.0 - faults.robot_part * (1.0 + 0.2 * np.sin(9.0 * u + camera))
        part = np.clip((v - edge) * height + 0.5, 0.0, 1.0)
        size = (width * _PART_TEXEL_M, height * _PART_TEXEL_M)
        texture = dead_leaves(size, _PART_TEXEL_M, Texture(camera, 1.0), _PART_STREAM)[:height, :width]
    if faults.dirt:
        rng = np.random.default_rng([camera, _DIRT_STREAM])
        share = np.ones((height, width))
        for _ in range(faults.dirt):
            x, y = rng.random(2)
            size = rng.uniform(*_DIRT_SIZE)
            square = (u - x) ** 2 + ((v - y) * height / width) ** 2
            share *= 1.0 - rng.uniform(*_DIRT_DARK) * np.exp(-0.5 * square / size**2)
    return CameraFaults(share, part, texture)


# Description of a simulation, as frozen dataclasses: true rig, motion and all disturbances.

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
    from t_imu = t_cam + time_offset_s + 1e-6 clock_rate_ppm (t_cam - t_mid), each since the origin of its clock; t_mid
    is the middle of the recording. Stamps are rounded to ns, and the truth is evaluated at the rounded stamp.
    intrinsics: fx, fy, cx, cy [px]. bloom_px: edge bloom, which moves each corner in the image towards the centre of
    its tag. dropouts: there are no images in these intervals. readout_s: from the exposure of the first row, or column
    (`rolling`), to that of the one after the last; stamps are those of the middle; 0: global shutter.
    Raises RigError for an unknown model.
    """

    name: str
    model: str
    resolution: tuple[int, int]
    intrinsics: tuple[float, ...]
    distortion: tuple[float, ...]
    T_imu_sensor: np.ndarray  # (4, 4)
    time_offset_s: float = 0.0
    clock_rate_ppm: float = field(default=0.0, kw_only=True)
    rate_hz: float = 20.0
    phase_s: float = 0.0
    clock_origin_ns: int = 0
    jitter_s: float = 0.0  # instants shifted by uniform +-jitter_s, below half a period
    corner_noise_px: float = 0.2
    bloom_px: float = 0.0
    dropouts: tuple[Interval, ...] = ()
    readout_s: float = 0.0
    rolling: Rolling = "rows"

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise RigError(
                f"{self.name}: the simulator has no camera model {self.model!r}; available are {', '.join(MODELS)}."
            )

    def true_parameters(self) -> TrueParameters:
        lens = {INTRINSICS.name: np.array(self.intrinsics), DISTORTION.name: np.array(self.distortion)}
        readout = {READOUT.name: np.array([self.readout_s])} if self.readout_s else {}
        return TrueParameters({**lens, BLOOM.name: np.array([self.bloom_px]), **readout})


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
    imu_cutoff_hz: float | None = None  # of a Gaussian low-pass without delay, -3 dB; None: as imu_sampling says
    imu_accel_delay_s: float = 0.0  # the accelerometer measures this long before the stamp of its reading
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
    def sheets(self) -> np.ndarray:
        """(n, 4, 3) both sides of the boards whose `sheet` is given, in the form of `Room.faces`."""
        faces = []
        for T, (low, high), has_sheet in zip(
            self.body_poses, self.target_size * self.target.outlines, self.target.has_sheet, strict=True
        ):
            along, across = (high - low)[:, None] * T[:3, :2].T
            if self.board and has_sheet:
                corner = T[:3, :2] @ low + T[:3, 3]
                faces += [(corner, along, across, np.zeros(3)), (corner, across, along, np.zeros(3))]
        return np.array(faces).reshape(-1, 4, 3)

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


# Reads fields of a scenario file that several sections share.

CLOCK = ("T_imu_sensor", "rate")
CLOCK_OPTIONS = ("time_offset", "clock_rate", "phase")


def mounted_fields(
    value: YamlValue, start_ns: int, required: tuple[str, ...] = (), options: tuple[str, ...] = ()
) -> tuple[dict[str, YamlValue], dict[str, Any]]:
    """The section of a sensor on the robot. required, options: fields of its kind, beside those that all sensors have.
    Returns all fields, and the values of the common ones by their names in `SimSensor`. start_ns: origin of all clocks
    [ns]. Raises RigError naming file, line and field."""
    fields = value.record(("type", *CLOCK, *required), (*CLOCK_OPTIONS, *options))
    common = {
        "T_imu_sensor": pose(fields["T_imu_sensor"]),
        "time_offset_s": fields["time_offset"].number() if "time_offset" in fields else 0.0,
        "clock_rate_ppm": fields["clock_rate"].number() if "clock_rate" in fields else 0.0,
        "rate_hz": fields["rate"].positive(),
        "phase_s": at_least(fields["phase"], 0.0) if "phase" in fields else 0.0,
        "clock_origin_ns": start_ns,
    }
    return fields, common


def imu_noise(value: YamlValue) -> ImuNoise:
    """The noise densities of an IMU."""
    names = ("gyro", "gyro_walk", "accel", "accel_walk")
    densities = value.record(names)
    return ImuNoise(**{name: densities[name].positive() for name in names}, source="scenario")


def at_least(value: YamlValue, least: float) -> float:
    number = value.number()
    if number < least:
        value.fail(f"must be at least {least:g}, but is {number:g}.")
    return number


def share(value: YamlValue) -> float:
    number = at_least(value, 0.0)
    if number > 1.0:
        value.fail(f"must be at most 1, but is {number:g}.")
    return number


def intervals(value: YamlValue) -> tuple[tuple[float, float], ...]:
    return tuple(interval(item) for item in value.items())


def interval(value: YamlValue) -> tuple[float, float]:
    low, high = value.vector(2).tolist()
    if low > high:
        value.fail(f"must be [lowest, highest], but is [{low:g}, {high:g}].")
    return low, high


def triple(value: YamlValue) -> tuple[float, float, float]:
    """Three positive numbers."""
    sides = value.items()
    if len(sides) != 3:
        value.fail(f"must be a list of 3 numbers, but has {len(sides)}.")
    return sides[0].positive(), sides[1].positive(), sides[2].positive()


def pose(value: YamlValue) -> np.ndarray:
    """(4, 4) pose, its rotation made orthonormal."""
    rows = value.items()
    if len(rows) != 4:
        value.fail(f"must be 4 rows of 4 numbers, but has {len(rows)}.")
    T = np.array([row.vector(4) for row in rows])
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0.0 or (T[3] != [0, 0, 0, 1]).any():
        value.fail("is not a pose: its first three columns must be a rotation, its last row 0, 0, 0, 1; correct it.")
    return pose_from_rows(T)


def pose_from_rows(rows: object) -> np.ndarray:
    """4x4 pose from printed numbers: the rotation is made orthonormal (nearest in the Frobenius norm, by SVD)."""
    T = np.array(rows, dtype=np.float64)
    left, _, right = np.linalg.svd(T[:3, :3])
    T[:3, :3] = left @ right
    return T

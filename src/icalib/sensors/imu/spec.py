"""An IMU in the rig file: its noise and intrinsics, and defaults for classes of IMUs."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.sensors.fields import (
    TABLE,
    axes_or_none,
    choice_or,
    layout_to_plain,
    parameter_to_plain,
    parameters,
    table_layout,
    vector_parameter,
)
from icalib.sensors.parameter import Parameter, ParameterSpec
from icalib.sensors.sensor import CLOCK_RATE, MOUNTED, PLAIN_TABLE, Axes, MountedSensor, Sampling, TableLayout


@dataclass(frozen=True)
class ImuNoise:
    """Continuous-time noise: gyro rad/s/sqrt(Hz), gyro_walk rad/s^2/sqrt(Hz), accel m/s^2/sqrt(Hz), accel_walk
    m/s^3/sqrt(Hz)."""

    gyro: float
    gyro_walk: float
    accel: float
    accel_walk: float
    source: str = "rig file"  # or "default for a consumer IMU", printed with the result

    @property
    def densities(self) -> np.ndarray:
        """(4,) gyro, gyro_walk, accel, accel_walk."""
        return np.array([self.gyro, self.gyro_walk, self.accel, self.accel_walk])

    def scaled(self, factor: float) -> ImuNoise:
        """The noise of an IMU `factor` times as noisy."""
        four = (float(factor * density) for density in self.densities)
        return replace(self, **dict(zip(("gyro", "gyro_walk", "accel", "accel_walk"), four, strict=True)))


@dataclass(frozen=True)
class Imperfections:
    """Standard deviations of the parameters of the scale-misalignment model (`motion.imu_data`) about the ideal
    IMU. Scales are relative; misalignments of an axis and the rotation between gyroscope and accelerometer are in
    rad; g-sensitivity is in rad/s per m/s^2."""

    accel_scale: float
    accel_misalignment: float
    gyro_scale: float
    gyro_misalignment: float
    rotation: float
    g_sensitivity: float

    @property
    def sigma(self) -> np.ndarray:
        """(24,) standard deviations in the order of `INTRINSICS_LABELS`."""
        lower = (0, 1, 0, 1, 1, 0)  # xx yx yy zx zy zz: 0 on the diagonal
        accel = [(self.accel_scale, self.accel_misalignment)[k] for k in lower]
        gyro = [(self.gyro_scale, self.gyro_misalignment)[k] for k in lower]
        return np.array([*accel, *gyro, *[self.rotation] * 3, *[self.g_sensitivity] * 9])


DEFAULT_CLASS = "consumer"
INTRINSICS_LABELS = (
    *(f"accel_{n}" for n in ("xx", "yx", "yy", "zx", "zy", "zz")),
    *(f"gyro_{n}" for n in ("xx", "yx", "yy", "zx", "zy", "zz")),
    *(f"accel_rotation_{n}" for n in "xyz"),
    *(f"g_sensitivity_{a}{b}" for a in "xyz" for b in "xyz"),
)
N_INTRINSICS = len(INTRINSICS_LABELS)
INTRINSICS = ParameterSpec("intrinsics", N_INTRINSICS, "nuisance", "", INTRINSICS_LABELS, 1e-2, 0.1, is_effect=True)
SIZE_EFFECT = ParameterSpec(
    name="size_effect",
    size=6,
    manifold="nuisance",
    unit="m",
    labels=("yx", "yy", "yz", "zx", "zy", "zz"),
    tolerance=1e-3,
    prior_sigma=5e-3,
    one="size_effect",
    is_effect=True,
    largest=1.0,
    meaning="places of the accelerometer's y and z axes relative to that of its x axis",
)
ACCEL_DELAY = ParameterSpec(
    name="accel_delay",
    size=1,
    manifold="nuisance",
    unit="s",
    labels=("accel_delay",),
    tolerance=1e-3,
    prior_sigma=1e-3,
    is_effect=True,
    largest=0.5,
    meaning="how long before its stamps the accelerometer measures",
)
LOW_PASS = ParameterSpec(
    name="low_pass",
    size=1,
    manifold="nuisance",
    unit="s^2",
    labels=("low_pass",),
    tolerance=1e-4,
    prior_sigma=1e-5,  # a Gaussian filter of 30 Hz
    least=0.0,
    largest=1e-2,  # a filter of 0.9 Hz
    is_auxiliary=True,
    is_effect=True,
    is_considered=True,
    meaning="low-pass filter of the IMU, as half the variance of its response",
)
# Effects on the readings, see `motion.imu_data`; none is in the model unless the rig file has it.
EFFECTS = (SIZE_EFFECT, ACCEL_DELAY, LOW_PASS)

# gyro, gyro_walk, accel, accel_walk in the units of ImuNoise, from:
# consumer: Bosch BMI160 of the TUM VI data set (Schubert et al., IROS 2018), as OpenVINS sets it for that data set.
# industrial: Analog Devices ADIS16448 as the EuRoC data set publishes it (Burri et al., IJRR 2016).
# tactical: Honeywell HG1700 data sheet, 0.125 deg/sqrt(h) and 0.065 ft/s/sqrt(h). The walks reach its biases of 1 deg/h
# and 1 mg in an hour.
_FIGURES = {
    "consumer": (1.6e-4, 2.2e-5, 2.8e-3, 8.6e-4),
    "industrial": (1.7e-4, 1.94e-5, 2.0e-3, 3.0e-3),
    "tactical": (3.6e-5, 8.1e-8, 3.3e-4, 1.6e-4),
}
IMU_CLASSES = tuple(_FIGURES)

# Tolerances of data sheets count as two standard deviations, typical values as one. The rotation between gyroscope and
# accelerometer has the misalignments of both to the case, as no sheet says that these are common.
# consumer: InvenSense MPU-6050 (PS-MPU-6000A, tables 6.1 and 6.2): scales +-3 %, cross-axis sensitivity +-2 %, 0.1
# deg/s/g typical. MPU-9250 (PS-MPU-9250A, tables 1 and 2): the same scales and cross-axis sensitivity.
# industrial: Analog Devices ADIS16448: scales +-1 %, axes 0.2 deg (accelerometer) and 0.05 deg (gyroscope) from
# perpendicular, 0.5 deg to the case, 0.015 deg/s/g. ADIS16460, table 1: 1 %, 0.05 deg, 1 deg to the
# case, 0.01 deg/s/g.
# tactical: Safran STIM300 (TS1524): scales 300 ppm (accelerometer) and 500 ppm (gyroscope), axes 1 mrad, 1 deg/h/g
# after its compensation, all typical.
_IMPERFECTIONS = {
    "consumer": Imperfections(0.015, 0.01, 0.015, 0.01, 0.014, 1.8e-4),
    "industrial": Imperfections(0.005, 1.7e-3, 0.005, 4.4e-4, 6.2e-3, 2.7e-5),
    "tactical": Imperfections(3e-4, 1e-3, 5e-4, 1e-3, 1.4e-3, 4.9e-7),
}
# Prior of IMU intrinsics that are `free`: wider than any class, so that it hardly influences a calibration.
FREE = Imperfections(0.05, 0.05, 0.05, 0.05, 0.05, 0.01)
# Largest ratio of the densities of a tactical IMU to those of its class. Consumer and industrial IMUs have the same
# noise and differ by their factory calibration, so that noise alone never makes an IMU industrial.
_LARGEST_TACTICAL_RATIO = 2.0


def class_noise(name: str) -> ImuNoise:
    """The default noise of one of IMU_CLASSES; `source` names the class."""
    article = "an" if name[0] in "aeiou" else "a"
    return ImuNoise(*_FIGURES[name], source=f"default for {article} {name} IMU")


def class_imperfections(name: str) -> Imperfections:
    """The imperfections of one of IMU_CLASSES."""
    return _IMPERFECTIONS[name]


def class_of_noise(noise: ImuNoise) -> str:
    """The class of an IMU by its noise: the class whose default it is; otherwise tactical if the noise is as small,
    else consumer."""
    imu_class = next((name for name in IMU_CLASSES if class_noise(name).source == noise.source), None)
    if imu_class is not None:
        return imu_class
    is_tactical = bool((noise.densities <= _LARGEST_TACTICAL_RATIO * np.array(_FIGURES["tactical"])).all())
    return "tactical" if is_tactical else DEFAULT_CLASS


def prior_words(sigma: np.ndarray) -> str:
    """Words on whose standard deviations `sigma` (24,) of the intrinsics are: a class, or the rig file."""
    name = next((name for name, prior in _IMPERFECTIONS.items() if np.array_equal(prior.sigma, sigma)), None)
    return "from the rig file" if name is None else f"of {'an' if name[0] in 'aeiou' else 'a'} {name} IMU"


@dataclass(frozen=True)
class TwoSources:
    """Topics or tables of an IMU with separate ones for gyroscope and accelerometer."""

    gyro: str
    accel: str


AccelUnit = Literal["m/s^2", "g"]
GyroUnit = Literal["rad/s", "deg/s"]
IDEAL = Parameter("fixed")  # without an effect
UNFILTERED = Parameter("fixed", np.zeros(LOW_PASS.size))  # known to have no filter
BY_CLASS = Parameter("free")  # no `intrinsics` field in the rig file; differs from `free()` by identity only
_CLASS_PRIORS = {n: Parameter("prior", np.zeros(N_INTRINSICS), class_imperfections(n).sigma, True) for n in IMU_CLASSES}
_DENSITIES = ("gyro", "gyro_walk", "accel", "accel_walk")
_FIELDS = ("accel_unit", "gyro_unit", "accel_axes", "gyro_axes", "sampling")
_MOUNT = (*(spec.name for spec in (*MOUNTED, CLOCK_RATE)), "clock_restarts")


@dataclass(frozen=True)
class ImuSensor(MountedSensor):
    """An IMU.

    mounted: set by `Rig`; False for the IMU that is the body, which has neither extrinsics nor a clock of its own.

    Units and axes describe the recorded readings; None: SI units (g is recognised), and axes of the IMU frame.
    sampling: `interval-mean` for IMUs whose readings are angles and velocity changes over the time that they took.
    assumed: no real IMU, but an assumption of smooth motion (see `initialize.assumed_motion`). intrinsics (24,): see
    `motion.imu_data`. Their default prior is that of the IMU's class about the ideal IMU. Free intrinsics have a broad
    prior about the initial guess. Intrinsics fixed without a value are those of the ideal IMU. size_effect (6,): places
    [m] of the accelerometer's y and z axes relative to that of x; fixed without a value: all at one place. accel_delay
    [s], low_pass [s^2]: see `motion.imu_data`.
    """

    sensor_type: ClassVar[str] = "imu"
    noun: ClassVar[str] = "IMU"
    is_inertial: ClassVar[bool] = True
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (*MOUNTED, CLOCK_RATE, INTRINSICS, *EFFECTS)

    path: str | TwoSources
    noise: ImuNoise
    intrinsics: Parameter = BY_CLASS
    size_effect: Parameter = IDEAL
    accel_delay: Parameter = IDEAL
    low_pass: Parameter = IDEAL
    topic: str | TwoSources | None = None  # in a bag; None: the one with the sensor's name, or the only one
    accel_unit: AccelUnit | None = None
    gyro_unit: GyroUnit | None = None
    accel_axes: Axes | None = None
    gyro_axes: Axes | None = None
    sampling: Sampling = "instantaneous"
    assumed: bool = False
    pose_keyframes_s: float = 0.02  # interval between keyframes if the motion is determined by poses alone
    layout: TableLayout = PLAIN_TABLE
    mounted: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.intrinsics is BY_CLASS:
            object.__setattr__(self, "intrinsics", _CLASS_PRIORS[class_of_noise(self.noise)])
        elif self.intrinsics.mode == "free":
            start = np.zeros(N_INTRINSICS) if self.intrinsics.value is None else self.intrinsics.value
            object.__setattr__(self, "intrinsics", Parameter("prior", start, FREE.sigma, True))

    def specs(self) -> tuple[ParameterSpec, ...]:
        """See `Sensor`; extrinsics and clock only where `mounted`, effects only where the rig file has them."""
        specs = self.parameters if self.mounted else (INTRINSICS, *EFFECTS)
        parameters: dict[str, Parameter] = vars(self)
        ideal = [s for s in EFFECTS if (p := parameters[s.name]).mode == "fixed" and p.value is None]
        return tuple(spec for spec in specs if spec not in ideal)

    @classmethod
    def parse(cls, name: str, value: YamlValue) -> ImuSensor:
        effects = [spec.name for spec in EFFECTS]
        options = ("path", "topic", "noise", "intrinsics", *effects, *_FIELDS, *TABLE, *_MOUNT)
        fields = value.record(("type",), options)
        units: dict[str, Any] = {
            field: fields[field].choice("such unit as", get_args(kind))
            for field, kind in (("accel_unit", AccelUnit), ("gyro_unit", GyroUnit))
            if field in fields
        }
        groups = parameters(fields, (*MOUNTED, CLOCK_RATE, *EFFECTS))
        if "intrinsics" in fields:
            groups["intrinsics"] = _intrinsics(fields["intrinsics"])
        return cls(
            name=name,
            path=_source(fields["path"]) if "path" in fields else f"{name}/data.csv",
            noise=_noise(fields["noise"]) if "noise" in fields else class_noise(DEFAULT_CLASS),
            topic=_source(fields["topic"]) if "topic" in fields else None,
            accel_axes=axes_or_none(fields, "accel_axes"),
            gyro_axes=axes_or_none(fields, "gyro_axes"),
            sampling=choice_or(fields, "sampling", Sampling, cls.sampling),
            layout=table_layout(fields),
            **units,
            **groups,
        )

    def plain(self) -> dict[str, Any]:
        plain: dict[str, Any] = {"type": "imu", "path": _plain_source(self.path)}
        plain["noise"] = dataclasses.asdict(self.noise)
        plain |= layout_to_plain(self.layout)
        if self.topic is not None:
            plain["topic"] = _plain_source(self.topic)
        for field in _FIELDS:
            given = getattr(self, field)
            if given is not None:
                plain[field] = list(given) if isinstance(given, tuple) else given
        plain |= {"clock_restarts": True} if self.clock_restarts else {}
        groups = {spec.name: parameter_to_plain(getattr(self, spec.name)) for spec in self.specs()}
        groups[INTRINSICS.name] = groups[INTRINSICS.name] or "fixed"
        return plain | {name: value for name, value in groups.items() if value is not None}


def _noise(value: YamlValue) -> ImuNoise:
    if not value.is_mapping:
        return class_noise(value.choice("IMU class", IMU_CLASSES))
    fields = value.record(_DENSITIES, ("source",))
    densities = {name: fields[name].positive() for name in _DENSITIES}
    return ImuNoise(**densities, source=fields["source"].text() if "source" in fields else ImuNoise.source)


def _source(value: YamlValue) -> str | TwoSources:
    """One name, or one each for gyroscope and accelerometer."""
    if not value.is_mapping:
        return value.text()
    fields = value.record(("gyro", "accel"))
    return TwoSources(fields["gyro"].text(), fields["accel"].text())


def _plain_source(source: str | TwoSources) -> str | dict[str, str]:
    return dataclasses.asdict(source) if isinstance(source, TwoSources) else source


def _intrinsics(value: YamlValue) -> Parameter:
    """The intrinsics (24,), zero for an ideal IMU. The name of a class stands for its prior about the ideal IMU;
    `fixed` stands for the ideal IMU."""
    if value.is_mapping or value.is_list or value.text() == "free":
        return vector_parameter(value, N_INTRINSICS)
    name = value.choice("treatment of IMU intrinsics", ("free", "fixed", *IMU_CLASSES))
    if name == "fixed":
        return Parameter("fixed")
    return Parameter("prior", np.zeros(N_INTRINSICS), class_imperfections(name).sigma)

"""IMU noise by class of sensor, for a rig file that does not give its own."""

from __future__ import annotations

from icalib.rig import ImuNoise

DEFAULT_CLASS = "consumer"

# gyro, gyro_walk, accel, accel_walk in the units of ImuNoise. Where they come from:
# consumer: Bosch BMI160 of the TUM VI data set (Schubert et al., IROS 2018), as OpenVINS sets it for that data set.
# industrial: Analog Devices ADIS16448 as the EuRoC data set publishes it (Burri et al., IJRR 2016).
# tactical: Honeywell HG1700 data sheet, 0.125 deg/sqrt(h) and 0.065 ft/s/sqrt(h); its biases of 1 deg/h and 1 mg are
# taken as what the walks reach in an hour.
_FIGURES = {
    "consumer": (1.6e-4, 2.2e-5, 2.8e-3, 8.6e-4),
    "industrial": (1.7e-4, 1.94e-5, 2.0e-3, 3.0e-3),
    "tactical": (3.6e-5, 8.1e-8, 3.3e-4, 1.6e-4),
}
IMU_CLASSES = tuple(_FIGURES)


def class_noise(name: str) -> ImuNoise:
    """The figures of one of IMU_CLASSES; their source says that they are defaults."""
    article = "an" if name[0] in "aeiou" else "a"
    return ImuNoise(*_FIGURES[name], source=f"default for {article} {name} IMU")

"""IMU noise by class of sensor, for a rig file that does not give its own."""

from __future__ import annotations

from icalib.rig import ImuNoise

DEFAULT_CLASS = "consumer"

# gyro, gyro_walk, accel, accel_walk in the units of ImuNoise. Where they come from:
# consumer: Bosch BMI160 as the TUM VI data set uses it (Schubert et al., IROS 2018), walks widened for temperature.
# industrial: Analog Devices ADIS16448 as the EuRoC data set publishes it (Burri et al., IJRR 2016).
# tactical: Honeywell HG4930 data sheet, 0.04 deg/sqrt(h) and 0.03 m/s/sqrt(h); walks from the in-run bias stability
# (0.25 deg/h, 0.025 mg) reached in 100 s.
_FIGURES = {
    "consumer": (1.6e-4, 2.2e-5, 2.8e-3, 8.6e-4),
    "industrial": (1.7e-4, 1.94e-5, 2.0e-3, 3.0e-3),
    "tactical": (1.2e-5, 1.2e-7, 5.0e-4, 2.5e-5),
}
IMU_CLASSES = tuple(_FIGURES)


def class_noise(name: str) -> ImuNoise:
    """The figures of one of IMU_CLASSES; their source says that they are defaults."""
    article = "an" if name[0] in "aeiou" else "a"
    return ImuNoise(*_FIGURES[name], source=f"default for {article} {name} IMU")

"""A plausible result."""

from tests.calibrations import calibration, robot, without_cameras  # noqa: F401 fixtures

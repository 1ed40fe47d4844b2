"""The kinds of sensors in each stage: one object of each kind for each stage.

Tables are filled at the first use, so that a stage loads only what it needs. This module alone may import from levels
above the one that asks. All tables have all kinds, in the order of sensors in layouts and results, but for
`simulated_kinds`.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from icalib.data.recording import Reader
    from icalib.initialize.initializer import Initializer
    from icalib.model.sensor_model import SensorModel
    from icalib.observability.assessor import Assessor
    from icalib.report.page import Presenter
    from icalib.tools.inspection.facts import KindInspector
    from icalib.tools.simulation.scenario import SimSensor


@cache
def readers() -> dict[str, Reader[Any]]:
    """How recordings are read, by type of sensor."""
    from icalib.sensors.camera import read as camera
    from icalib.sensors.imu import read as imu
    from icalib.sensors.lidar import read as lidar
    from icalib.sensors.pose import read as pose
    from icalib.sensors.position import read as position
    from icalib.sensors.wheels import read as wheels

    return {
        "imu": imu.READER,
        "camera": camera.READER,
        "lidar": lidar.READER,
        "wheels": wheels.READER,
        "pose": pose.READER,
        "position": position.READER,
    }


@cache
def models() -> dict[str, SensorModel[Any, Any]]:
    """How sensors enter the problem, by type of sensor."""
    from icalib.sensors.camera import model as camera
    from icalib.sensors.imu import model as imu
    from icalib.sensors.lidar import model as lidar
    from icalib.sensors.pose import model as pose
    from icalib.sensors.position import model as position
    from icalib.sensors.wheels import model as wheels

    return {
        "imu": imu.MODEL,
        "camera": camera.MODEL,
        "lidar": lidar.MODEL,
        "wheels": wheels.MODEL,
        "pose": pose.MODEL,
        "position": position.MODEL,
    }


@cache
def initializers() -> dict[str, Initializer[Any]]:
    """How sensors take part in the initial guess, by type of sensor."""
    from icalib.sensors.camera import initialize as camera
    from icalib.sensors.imu import initialize as imu
    from icalib.sensors.lidar import initialize as lidar
    from icalib.sensors.pose import initialize as pose
    from icalib.sensors.position import initialize as position
    from icalib.sensors.wheels import initialize as wheels

    return {
        "imu": imu.INITIALIZER,
        "camera": camera.INITIALIZER,
        "lidar": lidar.INITIALIZER,
        "wheels": wheels.INITIALIZER,
        "pose": pose.INITIALIZER,
        "position": position.INITIALIZER,
    }


@cache
def assessors() -> dict[str, Assessor[Any]]:
    """What results say of sensors, by type of sensor."""
    from icalib.sensors.camera import assess as camera
    from icalib.sensors.imu import assess as imu
    from icalib.sensors.lidar import assess as lidar
    from icalib.sensors.pose import assess as pose
    from icalib.sensors.position import assess as position
    from icalib.sensors.wheels import assess as wheels

    return {
        "imu": imu.ASSESSOR,
        "camera": camera.ASSESSOR,
        "lidar": lidar.ASSESSOR,
        "wheels": wheels.ASSESSOR,
        "pose": pose.ASSESSOR,
        "position": position.ASSESSOR,
    }


@cache
def presenters() -> dict[str, Presenter[Any]]:
    """What report, console and 3D view show of sensors, by type of sensor."""
    from icalib.sensors.camera import show as camera
    from icalib.sensors.imu import show as imu
    from icalib.sensors.lidar import show as lidar
    from icalib.sensors.pose import show as pose
    from icalib.sensors.position import show as position
    from icalib.sensors.wheels import show as wheels

    return {
        "imu": imu.PRESENTER,
        "camera": camera.PRESENTER,
        "lidar": lidar.PRESENTER,
        "wheels": wheels.PRESENTER,
        "pose": pose.PRESENTER,
        "position": position.PRESENTER,
    }


@cache
def inspectors() -> dict[str, KindInspector]:
    """How `icalib inspect` finds sensors in a recording, by type of sensor."""
    from icalib.sensors.camera import inspect as camera
    from icalib.sensors.imu import inspect as imu
    from icalib.sensors.lidar import inspect as lidar
    from icalib.sensors.pose import inspect as pose
    from icalib.sensors.position import inspect as position
    from icalib.sensors.wheels import inspect as wheels

    return {
        "imu": imu.INSPECTOR,
        "camera": camera.INSPECTOR,
        "lidar": lidar.INSPECTOR,
        "wheels": wheels.INSPECTOR,
        "pose": pose.INSPECTOR,
        "position": position.INSPECTOR,
    }


@cache
def simulated_kinds() -> dict[str, type[SimSensor]]:
    """Classes of simulated sensors by type of sensor; the first IMU and cameras are parts of the scenario."""
    from icalib.sensors.imu import simulate as imu
    from icalib.sensors.lidar import simulate as lidar
    from icalib.sensors.pose import simulate as pose
    from icalib.sensors.position import simulate as position
    from icalib.sensors.wheels import simulate as wheels

    return {
        "imu": imu.SIMULATED,
        "lidar": lidar.SIMULATED,
        "wheels": wheels.SIMULATED,
        "pose": pose.SIMULATED,
        "position": position.SIMULATED,
    }

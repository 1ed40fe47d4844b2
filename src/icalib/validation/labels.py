"""Units and labels of the groups of parameters."""

from __future__ import annotations

from icalib.estimate.problem.inputs import Inputs
from icalib.geometry.cameras import camera_model
from icalib.motion.imu_model import LABELS as IMU_LABELS
from icalib.optim.state import Block
from icalib.rig import Camera
from icalib.sensors.camera.board import SHAPE_LABELS

UNITS = {
    "rotation": "rad",
    "translation": "m",
    "time_offset": "s",
    "intrinsics": "px",
    "distortion": "",
    "bloom": "px",
    "shape": "m",
    "tilt": "rad",
    "radii": "m",
    "baseline": "m",
    "radius": "m",
    "wheelbase": "m",
    "steering_offset": "rad",
    "scales": "",
    "ground_height": "m",
    "size": "",
    "scale": "",
}
LABELS = {
    "shape": SHAPE_LABELS,
    "radii": ("left", "right"),
    "scales": ("speed", "yaw_rate"),
    "plane": ("turn 1", "turn 2", "distance"),
}


def labels_of(inputs: Inputs, block: Block) -> tuple[str, ...]:
    """One for each number of a group."""
    if inputs.imu is not None and block.sensor == inputs.imu.name:
        return IMU_LABELS
    if block.name in ("intrinsics", "distortion"):
        camera = inputs.sensor(block.sensor)
        assert isinstance(camera, Camera)
        model = camera_model(camera.model).parameter_names
        return model[:4] if block.name == "intrinsics" else model[4:]
    if block.name in LABELS:
        return LABELS[block.name]
    if block.name == "time_offset" and block.size > 1:
        return tuple(f"in recording {k}" for k in range(1, block.size + 1))
    return ("x", "y", "z")[: block.size] if block.size > 1 else (block.name,)

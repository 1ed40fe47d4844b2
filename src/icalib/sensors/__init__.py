"""The kinds of sensors: one folder each. `CONTRIBUTING.md` lists what a new kind has, and where it is registered.

A module or package of a fixed name in the folder of a kind serves one stage of the program. It holds one object of the
class that the stage defines; `kinds.py` lists these objects.
"""

from __future__ import annotations

# Order of sensors in layouts and results; sensors of one kind are in the order of the rig file.
SENSOR_KINDS = ("imu", "camera", "lidar", "wheels", "pose", "position")

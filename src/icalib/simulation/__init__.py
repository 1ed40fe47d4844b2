"""Simulated recordings with their truth, made with formulas of their own so that no sign can cancel."""

from icalib.simulation.corners import CornerTruth
from icalib.simulation.motion import Trajectory
from icalib.simulation.rigs import rig_for, settings_for
from icalib.simulation.scenario import ADIS16448, Motion, Scenario, SimCamera, handheld
from icalib.simulation.simulate import Simulation, Truth, simulate

__all__ = [
    "ADIS16448",
    "CornerTruth",
    "Motion",
    "Scenario",
    "SimCamera",
    "Simulation",
    "Trajectory",
    "Truth",
    "handheld",
    "rig_for",
    "settings_for",
    "simulate",
]

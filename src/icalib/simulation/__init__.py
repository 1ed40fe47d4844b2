"""Simulated recordings with their truth, made with formulas of their own so that no sign can cancel."""

from icalib.simulation.corners import CornerTruth
from icalib.simulation.filming import Film, Shot, film, sheets_of
from icalib.simulation.motion import Trajectory
from icalib.simulation.rendering import Imaging, Picture, Renderer, Sheet, SheetTruth, exposure_poses
from icalib.simulation.rigs import rig_for, settings_for
from icalib.simulation.scenario import ADIS16448, Motion, Scenario, SimCamera, handheld
from icalib.simulation.simulate import Simulation, Truth, simulate
from icalib.simulation.tag_map import tag_map
from icalib.simulation.writing import write_film

__all__ = [
    "ADIS16448",
    "CornerTruth",
    "Film",
    "Imaging",
    "Motion",
    "Picture",
    "Renderer",
    "Scenario",
    "Sheet",
    "SheetTruth",
    "Shot",
    "SimCamera",
    "Simulation",
    "Trajectory",
    "Truth",
    "exposure_poses",
    "film",
    "handheld",
    "rig_for",
    "settings_for",
    "sheets_of",
    "simulate",
    "tag_map",
    "write_film",
]

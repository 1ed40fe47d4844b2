"""Simulated recordings with their truth. Formulas are written separately from those of the estimator, so that a wrong
sign in one of them cannot cancel."""

from icalib.tools.simulation.corners import CornerTruth, TrackTruth
from icalib.tools.simulation.filming import Film, Shot, film, sheets_of
from icalib.tools.simulation.recording import Simulation, Truth, simulate
from icalib.tools.simulation.rendering import Imaging, Picture, Renderer, Sheet, SheetTruth, exposure_poses
from icalib.tools.simulation.rigs import GuessError, rig_for, settings_for, with_drawn_guess
from icalib.tools.simulation.room import Hills, Obstacle, Room, Texture, hills_of_slope
from icalib.tools.simulation.scenario import (
    ADIS16448,
    HandheldMotion,
    ImageFaults,
    Scenario,
    SimCamera,
    SimSensor,
    handheld,
)
from icalib.tools.simulation.scenario_file import load_scenario, tag_map
from icalib.tools.simulation.trajectory import Drive, Features, TrueTrajectory
from icalib.tools.simulation.writing import write_film, write_sensors, write_tables

__all__ = [
    "ADIS16448",
    "Obstacle",
    "CornerTruth",
    "Drive",
    "Features",
    "Film",
    "GuessError",
    "Hills",
    "ImageFaults",
    "Imaging",
    "HandheldMotion",
    "Picture",
    "Renderer",
    "Room",
    "Scenario",
    "Sheet",
    "SheetTruth",
    "Shot",
    "SimCamera",
    "SimSensor",
    "Simulation",
    "Texture",
    "TrackTruth",
    "TrueTrajectory",
    "Truth",
    "exposure_poses",
    "film",
    "handheld",
    "hills_of_slope",
    "load_scenario",
    "rig_for",
    "settings_for",
    "sheets_of",
    "simulate",
    "tag_map",
    "with_drawn_guess",
    "write_film",
    "write_sensors",
    "write_tables",
]

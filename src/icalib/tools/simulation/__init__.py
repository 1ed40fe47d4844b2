"""Simulated recordings with their truth. Formulas are written separately from those of the estimator, so that a wrong
sign in one of them cannot cancel."""

from icalib.tools.simulation.images.filming import Film, Shot, film, sheets_of
from icalib.tools.simulation.images.rendering import Imaging, Picture, Renderer, Sheet, SheetTruth, exposure_poses
from icalib.tools.simulation.rigs import GuessError, rig_for, settings_for, with_drawn_guess
from icalib.tools.simulation.scenario.image_faults import ImageFaults
from icalib.tools.simulation.scenario.robot import Drive, Features
from icalib.tools.simulation.scenario.room import Hills, Obstacle, Room, hills_of_slope
from icalib.tools.simulation.scenario.scenario import ADIS16448, HandheldMotion, Scenario, SimCamera, handheld
from icalib.tools.simulation.scenario.scenario_file import load_scenario
from icalib.tools.simulation.scenario.sensor import SimSensor
from icalib.tools.simulation.scenario.tag_map import tag_map
from icalib.tools.simulation.scenario.texture import Texture
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory
from icalib.tools.simulation.sensor_bag import write_sensors
from icalib.tools.simulation.sensors.corners import CornerTruth
from icalib.tools.simulation.sensors.simulate import Simulation, Truth, simulate
from icalib.tools.simulation.sensors.tracks import TrackTruth
from icalib.tools.simulation.tables import write_tables
from icalib.tools.simulation.writing import write_film

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

"""Simulated recordings with their truth, made with formulas of their own so that no sign can cancel."""

from icalib.simulation.corners import CornerTruth
from icalib.simulation.filming import Film, Shot, film, sheets_of
from icalib.simulation.image_faults import ImageFaults
from icalib.simulation.motion import Trajectory
from icalib.simulation.poses import PoseTruth
from icalib.simulation.rendering import Imaging, Picture, Renderer, Sheet, SheetTruth, exposure_poses
from icalib.simulation.rigs import GuessError, rig_for, settings_for, with_drawn_guess
from icalib.simulation.robot import Drive, Features, SimLidar, SimPoses, SimWheels
from icalib.simulation.room import Block, Hills, Room, hills_of_slope
from icalib.simulation.scenario import ADIS16448, Motion, Scenario, SimCamera, handheld
from icalib.simulation.scenario_file import load_scenario
from icalib.simulation.sensor_bag import write_sensors
from icalib.simulation.simulate import Simulation, Truth, simulate
from icalib.simulation.tables import write_tables
from icalib.simulation.tag_map import tag_map
from icalib.simulation.texture import Texture
from icalib.simulation.tracks import TrackTruth
from icalib.simulation.wheels import WheelTruth
from icalib.simulation.writing import write_film

__all__ = [
    "ADIS16448",
    "Block",
    "CornerTruth",
    "Drive",
    "Features",
    "Film",
    "GuessError",
    "Hills",
    "ImageFaults",
    "Imaging",
    "Motion",
    "Picture",
    "PoseTruth",
    "Renderer",
    "Room",
    "Scenario",
    "Sheet",
    "SheetTruth",
    "Shot",
    "SimCamera",
    "SimLidar",
    "SimPoses",
    "SimWheels",
    "Simulation",
    "Texture",
    "TrackTruth",
    "Trajectory",
    "Truth",
    "WheelTruth",
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

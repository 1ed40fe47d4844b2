"""The first guess from nothing: every stage needs only what the ones before it found, and none needs a guess."""

from icalib.initialization.guess import BoardPoses, CameraGuess, Guess
from icalib.initialization.initial_guess import initial_guess
from icalib.initialization.trajectory import initial_trajectory

__all__ = ["BoardPoses", "CameraGuess", "Guess", "initial_guess", "initial_trajectory"]

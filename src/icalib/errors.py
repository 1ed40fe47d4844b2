"""Every error a user can meet: one sentence that names what is wrong and what to do."""


class CalibrationError(Exception):
    """Base of all errors that icalib raises on purpose; `str(error)` is one sentence for the user."""


class RigError(CalibrationError):
    """The rig file is wrong; the sentence names file, line and field."""


class RecordingError(CalibrationError):
    """A recording cannot be read, or what it holds cannot be used; names file, sensor or instant."""


class EstimationError(CalibrationError):
    """The data are readable, but no calibration can be made from them; says what is missing."""

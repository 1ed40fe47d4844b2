"""Camera models by name."""

from __future__ import annotations

from icalib.errors import CalibrationError
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.cameras.double_sphere import DoubleSphere
from icalib.geometry.cameras.equidistant import PinholeEquidistant
from icalib.geometry.cameras.eucm import ExtendedUnified
from icalib.geometry.cameras.omni import OmniRadtan
from icalib.geometry.cameras.radtan import PinholeRadtan, PinholeRadtan5
from icalib.geometry.cameras.rational import PinholeRational

CAMERA_MODELS: dict[str, CameraModel] = {
    model.name: model
    for model in (
        PinholeRadtan(),
        PinholeRadtan5(),
        PinholeRational(),
        PinholeEquidistant(),
        ExtendedUnified(),
        DoubleSphere(),
        OmniRadtan(),
    )
}


def camera_model(name: str) -> CameraModel:
    """The model of this name. Raises CalibrationError, which lists the available names, if there is none."""
    if name not in CAMERA_MODELS:
        raise CalibrationError(f"there is no camera model {name!r}; available are {', '.join(CAMERA_MODELS)}.")
    return CAMERA_MODELS[name]

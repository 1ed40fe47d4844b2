"""Why an estimate failed: what is said was tried."""

from __future__ import annotations

from types import SimpleNamespace

from tests.cases import each

from icalib.errors import EstimationError
from icalib.initialize.rig_guess import explained_failure
from icalib.optim.arrowhead import NOT_DEFINITE, NotDefiniteError
from icalib.rig import Camera, ImuNoise, ImuSensor, PoseSensor, Rig, by_name

RELATIVE = Rig(by_name(ImuSensor("imu0", "", ImuNoise(1e-4, 1e-5, 1e-3, 1e-4)), PoseSensor("odom", "", "relative")))
BROKEN = NotDefiniteError(NOT_DEFINITE)


def converging(rig: Rig):
    assert [p.kind for p in rig.poses] == ["absolute"]
    return SimpleNamespace(converged=True)


def failing(rig: Rig):
    raise EstimationError("no.")


def test_relative_poses_that_would_work_as_absolute_ones_are_named():
    found = explained_failure(RELATIVE, [], converging, BROKEN)  # pyright: ignore
    assert str(found).startswith("odom: ") and "write kind: absolute" in str(found)


@each(
    ("rig", "make", "failed"),
    [
        (RELATIVE, failing, BROKEN),
        (RELATIVE, converging, EstimationError("the motion does not match.")),
        (RELATIVE.with_(cameras=(Camera("cam0", "", "pinhole-radtan", (640, 480)),)), converging, BROKEN),
        (RELATIVE.with_(poses=(PoseSensor("odom", ""),)), converging, BROKEN),
    ],
)
def test_what_was_not_tried_or_did_not_work_is_not_said(rig, make, failed):
    assert explained_failure(rig, [], make, failed) is failed

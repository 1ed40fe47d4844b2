"""Warnings on corners and tracks: residuals larger or smaller than their stated noise predicts, and many outliers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.factor import Factor, FactorKey, of_type
from icalib.result import SensorFit
from icalib.result.excess import excess, is_small, ratio, times
from icalib.rig import Camera, Rig
from icalib.sensors.camera.features.residual import FeatureFactor
from icalib.sensors.camera.features.surfaces import ON_PLANES

# RMS above which a warning is given: ten times the error of a detector, twice that of corners in blurred images.
POOR_CORNER_RMS_PX = 1.0
MANY_REJECTED_SHARE = 0.05  # of the corners or tracks of a camera, above which a warning is given
# Share of tracks on planes below which a warning is given. Rough walls leave a tenth where two thirds are expected.
FEW_ON_PLANES_SHARE = 0.1


def warnings(inputs: Inputs, estimate: Estimate) -> Iterator[str]:
    """A sentence if `points_on_planes_m` is set, but no or few tracked points lie on planes of LiDARs."""
    yield from _plane_warnings(inputs.rig, estimate.problem.factors)


def _plane_warnings(rig: Rig, factors: Mapping[FactorKey, Factor]) -> Iterator[str]:
    """A sentence if `points_on_planes_m` is set, but no tracked points lie on planes, or too few to exclude chance."""
    if rig.settings.points_on_planes_m == 0.0:
        return
    features = of_type(factors, FeatureFactor)
    on, tracks = sum(int((f.on.plane >= 0).sum()) for f in features), sum(f.tracks.count for f in features)
    if on == 0:
        yield (
            "no tracked points lie on planes of the LiDARs, so points_on_planes_m in the rig file has no effect; make "
            "it larger, or remove it if little is flat."
        )
    elif on < FEW_ON_PLANES_SHARE * tracks:
        yield (
            f"only {on} of the {tracks} tracks that cameras follow lie on planes of the LiDARs, so few that it may be "
            "chance; make points_on_planes_m in the rig file larger, or take it out where little is flat."
        )


def unreliable(rig: Rig, factors: Mapping[FactorKey, Factor]) -> Iterator[str]:
    """Kinds of residuals that mean nothing: those of points on planes if so few lie there that it may be chance."""
    if any(_plane_warnings(rig, factors)):
        yield ON_PLANES


def many_rejected(fits: Sequence[SensorFit]) -> Iterator[str]:
    """A sentence for each camera of which many corners or tracks are rejected."""
    for f in fits:
        if f.kind in ("corners", "features") and f.rejected > MANY_REJECTED_SHARE * 0.5 * f.count:
            share = f.rejected / (f.rejected + 0.5 * f.count)
            yield (
                f"{share:.0%} of the {f.kind} of {f.sensor} are rejected as outliers; look at its residuals in the "
                "report."
            )


def overstated_noise(rig: Rig, fits: Sequence[SensorFit]) -> Iterator[str]:
    """A sentence that names all cameras whose stated corner noise is too large.

    The trajectory then follows the IMU, and its residuals become small, too."""
    stated = {c.name for c in rig.cameras if c.corner_noise_px is not None}
    small = [f for f in fits if f.kind == "corners" and f.sensor in stated and is_small(f)]
    if small:
        sizes = " and ".join(f"{f.sensor} {ratio(f):.2g}x" for f in small)
        yield (
            f"residuals of corners are smaller than corner_noise predicts ({sizes}); standard deviations are too "
            "large. Leave corner_noise out, and it is estimated."
        )


def misfit(camera: Camera, f: SensorFit, is_noise: bool) -> str | None:
    """A sentence if residuals are larger than the stated noise predicts, or corners fit worse than
    `POOR_CORNER_RMS_PX`; else None. f: fit of corners or of points on planes."""
    if f.kind == ON_PLANES and excess(f) > 1.0:
        return (
            f"tracked points of {f.sensor} lie {times(f)} farther from planes of the LiDARs than points_on_planes_m "
            "predicts; make it larger, or take it out where little is flat."
        )
    if f.kind != "corners":
        return None
    if f.rms is not None and f.rms > POOR_CORNER_RMS_PX:
        return (
            f"the corners of {f.sensor} fit to {f.rms:.1f} px only, ten times the error of a detector, and the cause "
            "is unknown. Check its camera model, fixed intrinsics, its topic, the target in the rig file, jumps of its "
            "clock, and blur of its images."
        )
    if excess(f) > 1.0 and camera.corner_noise_px is not None:
        return (
            f"residuals of the corners of {f.sensor} are {times(f)} larger than its corner_noise predicts, and the "
            "cause is unknown. Check its camera model, fixed intrinsics and its topic; if all are right, leave "
            "corner_noise out, and it is estimated."
        )
    return None

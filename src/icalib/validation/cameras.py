"""Cameras that do not fit: taken for one another, or off by more than corners are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from icalib.geometry import so3
from icalib.motion.factor import Factor, FactorKey, of_type
from icalib.observability.fixed_lens import LensStep
from icalib.result import ParameterGroup, SensorFit
from icalib.result.excess import excess, times
from icalib.rig import Camera, Rig
from icalib.sensors.camera.features.feature_factor import FeatureFactor
from icalib.sensors.camera.features.surfaces import ON_PLANES
from icalib.sensors.camera.spec import INTRINSICS
from icalib.sensors.sensor import ROTATION, TRANSLATION

GIVEN = (ROTATION, TRANSLATION, INTRINSICS)
FAR = 0.5  # of what guesses are worth: 5 cm, 3 deg, 8 px
MUCH_NEARER = 0.3  # times as far, in all that is given
POOR_FIT_PX = 1.0  # RMS: detectors are off by a tenth of that, blurred images by half
MANY_REJECTED = 0.05
OTHER_LENS, CLEARLY = 0.015, 3.0  # of the focal length; standard deviations
FEW_ON_PLANES = 0.1  # of the tracks: rough walls have as many where they should have two thirds
NEARER = 0.5  # times as far, in fx, fy, cx and cy


def plane_warnings(rig: Rig, factors: Mapping[FactorKey, Factor]) -> Iterator[str]:
    """Where points should lie on planes, and none do, or so few that it may be chance."""
    if rig.settings.points_on_planes_m == 0.0:
        return
    features = of_type(factors, FeatureFactor)
    on, tracks = sum(int((f.on.plane >= 0).sum()) for f in features), sum(f.tracks.count for f in features)
    if on == 0:
        yield (
            "no tracked points lie on planes of the LiDARs, so points_on_planes_m in the rig file has no effect; make "
            "it larger, or remove it if little is flat."
        )
    elif on < FEW_ON_PLANES * tracks:
        yield (
            f"only {on} of the {tracks} tracks that cameras follow lie on planes of the LiDARs, so few that it may be "
            "chance; make points_on_planes_m in the rig file larger, or take it out where little is flat."
        )


def rejected_words(f: SensorFit) -> str | None:
    """A sentence where many corners or tracks of a camera are rejected."""
    if f.kind not in ("corners", "features") or f.rejected <= MANY_REJECTED * 0.5 * f.count:
        return None
    share = f.rejected / (f.rejected + 0.5 * f.count)
    return f"{share:.0%} of the {f.kind} of {f.sensor} are rejected as outliers; look at its residuals in the report."


def camera_misfit(rig: Rig, f: SensorFit) -> str | None:
    """A sentence where corners, or points on planes, leave more than is stated, or than detectors are off by."""
    if f.kind == ON_PLANES and excess(f) > 1.0:
        return (
            f"tracked points of {f.sensor} lie {times(f)} farther from planes of the LiDARs than points_on_planes_m "
            "predicts; make it larger, or take it out where little is flat."
        )
    if f.kind != "corners":
        return None
    if f.rms is not None and f.rms > POOR_FIT_PX:
        return (
            f"the corners of {f.sensor} fit to {f.rms:.1f} px only, ten times the error of a detector, and the cause "
            "is unknown. Check its camera model, fixed intrinsics, its topic, the target in the rig file, jumps of its "
            "clock, and blur of its images."
        )
    if excess(f) > 1.0 and f.sensor in {c.name for c in rig.cameras if c.corner_noise_px is not None}:
        return (
            f"residuals of the corners of {f.sensor} are {times(f)} larger than its corner_noise predicts, and the "
            "cause is unknown. Check its camera model, fixed intrinsics and its topic; if all are right, leave "
            "corner_noise out, and it is estimated."
        )
    return None


def mixed_up(cameras: Sequence[Camera], groups: Sequence[ParameterGroup]) -> Iterator[str]:
    """Pairs of which each is found about where the rig file has the other, and far from where it should be."""
    found = {(g.sensor, g.name): g.value for g in groups}
    for a, b in combinations(cameras, 2):
        own = _away(a, found, a.name), _away(b, found, b.name)
        crossed = _away(a, found, b.name), _away(b, found, a.name)
        if max(own) > FAR and max(crossed) < MUCH_NEARER * max(own):
            yield (
                f"{a.name} and {b.name} seem to be swapped: the pose and lens of each fit what the rig file gives of "
                "the other. Correct their topics or paths, or the values in the rig file."
            )


def other_lens(cameras: Sequence[Camera], steps: Sequence[LensStep], factor: float) -> Iterator[tuple[str, str, float]]:
    """Cameras whose intrinsics the rig file fixes at what cannot be theirs: name, sentence, and by how much chi^2 falls
    without that. `factor`: the largest empirical one."""
    given = {c.name: c.intrinsics.value for c in cameras}
    for found in steps:
        value = given[found.camera]
        assert value is not None
        off = np.abs(found.step)
        clearly = off > np.maximum(OTHER_LENS * value[0], CLEARLY * factor * found.std)
        if clearly.any():
            where = ", ".join(
                f"{name} {old + step:.1f} and not {old:.1f}"
                for name, old, step, far in zip(("fx", "fy", "cx", "cy"), value, found.step, clearly, strict=True)
                if far
            )
            nearer = [
                n for n, v in given.items() if v is not None and max(abs(value + found.step - v)) < NEARER * max(off)
            ]
            hint = f" Those of {nearer[0]} are nearer." if nearer else ""
            sentence = (
                f"the intrinsics of {found.camera} that the rig file fixes do not fit its images, which want {where}: "
                f"check that they are this camera's, at this resolution, or leave them free.{hint}"
            )
            yield found.camera, sentence, float(((found.step / found.std) ** 2).max())


def _away(camera: Camera, found: dict[tuple[str, str], np.ndarray], name: str) -> float:
    """How far camera `name` is from what the rig file gives of `camera`, in what guesses are worth."""
    away = 0.0
    for spec in GIVEN:
        given, value = getattr(camera, spec.name).value, found.get((name, spec.name))
        if given is None or value is None:
            continue
        off = so3.value_change(given, value)
        away = max(away, float(np.linalg.norm(off)) / spec.prior_sigma)
    return away

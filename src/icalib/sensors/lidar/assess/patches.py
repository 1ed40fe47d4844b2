"""Assessment of LiDARs at rest whose points lie on surfaces that several of them see."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.base.remark import Remark
from icalib.motion.factor import of_type
from icalib.observability.assessor import AssessedEstimate, Assessment
from icalib.sensors.lidar.patch_factor import PatchFactor


def on_patches(a: AssessedEstimate) -> Assessment:
    """What results say of LiDARs at rest."""
    return Assessment(notes=_notes(a))


def _notes(a: AssessedEstimate) -> Iterator[Remark]:
    """A note on the patches that each LiDAR sees, and how flat they are."""
    for f in of_type(a.estimate.problem.factors, PatchFactor):
        seen = np.unique(np.stack([f.points.patch, f.points.lidar]), axis=1)[1]
        counts = ", ".join(f"{n} by {name}" for name, n in zip(f.names, np.bincount(seen).tolist(), strict=True))
        stops = len(np.unique(f.points.keyframe))
        yield Remark(
            "lidar_surfaces_shared",
            f"LiDARs share {len(f.points.keyframe)} surfaces at {stops} {'stop' if stops == 1 else 'stops'}, seen "
            f"{counts}; points scatter {1e3 * f.patches.point_sigma:.1f} mm about them, and they deviate "
            f"{1e3 * f.noise.flatness:.1f} mm from planes.",
        )

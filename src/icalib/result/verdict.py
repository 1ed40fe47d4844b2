"""Verdict on a result, and its reasons."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal

import numpy as np

from icalib.base.remark import Remark
from icalib.motion.imu_data import hardly_turned
from icalib.result.derived import projection_uncertainty
from icalib.rig import Settings, prior_words
from icalib.rig.rig import ALL_SPECS, SENSOR_TYPES
from icalib.sensors.parameter import display_unit

if TYPE_CHECKING:
    from icalib.result.calibration import Calibration, ParameterGroup, Verdict


# Verdict on a result: whether it can be used, and why not. No other module decides this.
#
# Console, report, calibration.yaml, result.json and the exit code of `--strict` show this verdict. It is the worst
# that applies of:
#
#     not usable        the solver did not converge, or a check says that the rig file or the recording is wrong
#     partly usable     components are unobservable or too uncertain; all others can be used
#     usable with care  there is a warning, or a component whose standard deviation exceeds its tolerance
#     usable            none of these
#
# A lens is judged by its projection uncertainty over the image regions with observations, not by single coefficients,
# which are strongly correlated. A component with a prior does not count: it is at least as good as its prior. Nuisance
# parameters (edge bloom, board shape and tilt) do not count.

Usability = Literal["usable", "usable with care", "partly usable", "not usable"]

EXIT_CODES: dict[Usability, int] = {"usable": 0, "usable with care": 3, "partly usable": 4, "not usable": 5}
NEXT: dict[Usability, str] = {
    "usable": "The solver converged, every component that counts is determined, and no check failed.",
    "usable with care": "Read the reasons before you use the numbers.",
    "partly usable": (
        "Use no component that is marked unobservable, which depends on its initial guess alone, or too uncertain. Act "
        "on the reasons to determine it."
    ),
    "not usable": "Act on the first reason, then calibrate again.",
}
_MEANINGS: dict[Verdict, Remark] = {
    "unobservable": Remark("values_unobservable", "unobservable, the value depends on the initial guess; {more}"),
    "too uncertain": Remark(
        "values_too_uncertain", "too uncertain, the standard deviation exceeds ten tolerances; {more}"
    ),
    "weak": Remark(
        "values_weak",
        "weakly determined, the standard deviation exceeds the tolerance; {more}, or accept that uncertainty",
    ),
}
AUXILIARY = tuple(spec.name for spec in ALL_SPECS if spec.is_auxiliary)
WORST_FIRST: tuple[Verdict, ...] = ("unobservable", "too uncertain", "weak", "determined", "fixed")
UNUSABLE = WORST_FIRST[:2]  # verdicts on components that must not be used
TOO_UNCERTAIN = 10.0  # standard deviation in tolerances above which a component must not be used
NULL_SPACE_SHARE = 0.25  # squared norm of a component's unit vector in the null space; unobservable above it
MOST_NAMED = 6  # components that one sentence names
_MOST_BY_ONE = 0.5  # share of a variance from the prior on IMU intrinsics above which a better prior is the advice


def usability(c: Calibration) -> Usability:
    """The verdict on the whole result."""
    if not c.converged or c.wrong:
        return "not usable"
    verdicts = {v for g in c.groups for v in counted(c, g)}
    if verdicts & {*UNUSABLE}:
        return "partly usable"
    return "usable with care" if c.warnings or "weak" in verdicts else "usable"


def reasons(c: Calibration) -> tuple[Remark, ...]:
    """Sentences on why the verdict is not `usable`, the most important first; empty if it is."""
    if not c.converged:
        return tuple(dict.fromkeys([*c.wrong, failure_words(c.status), *c.warnings]))
    verdicts = {v for g in c.groups for v in counted(c, g)} & {"weak", *UNUSABLE}
    # Standard deviations of a wrong model include its misfit, which a longer recording does not reduce.
    unusable, weak = ([], []) if c.wrong else ([*_named(c, *UNUSABLE)], [*_named(c, "weak")])
    rest = [w for w in c.warnings if w not in c.wrong]
    # Unobservable coefficients of a lens matter little if its projection is known well enough, so they come last.
    directions = c.unobservable if verdicts else ()
    first, last = (directions, ()) if "unobservable" in verdicts else ((), directions)
    return tuple(dict.fromkeys([*c.wrong, *first, *unusable, *rest, *weak, *last]))


def failure_words(status: str) -> Remark:
    """A sentence that the solver did not converge. status: why, one sentence."""
    return Remark("solver_did_not_converge", f"the solver did not converge: {status}")


def component_verdict(tolerances: float, by_guess: bool = False) -> Verdict:
    """Verdict on a component whose standard deviation is `tolerances` times its tolerance; NaN is as infinity.
    by_guess: whether errors of the initial guess of unobservable directions are most of its variance."""
    if not tolerances <= TOO_UNCERTAIN:
        return "unobservable" if by_guess else "too uncertain"
    return "determined" if tolerances <= 1.0 else "weak"


def in_null_space(directions: np.ndarray) -> np.ndarray:
    """(B,) bool: whether the unit vector of each component lies largely in the null space (see `NULL_SPACE_SHARE`).
    directions (B, m): orthonormal basis of the null space, in tolerance units."""
    return (directions**2).sum(axis=1) > NULL_SPACE_SHARE


def worst(verdicts: tuple[Verdict, ...]) -> Verdict:
    """The worst of the verdicts of a group; `fixed` if there are none."""
    return min((*verdicts, WORST_FIRST[-1]), key=WORST_FIRST.index)


def lens_projections_px(c: Calibration) -> dict[str, float | None]:
    """`lens_projection_px` of every camera. `Calibration` caches it, as one camera takes about 20 ms."""
    return {camera: _lens_projection_px(c, camera) for camera in c.lenses}


def lens_projection_px(c: Calibration, camera: str) -> float | None:
    """Median standard deviation of the projection over the image cells in which `camera` has observations [px]. None if
    its lens is fixed, or its model has no ray in the image."""
    return c.lens_projections_px[camera]


def _lens_projection_px(c: Calibration, camera: str) -> float | None:
    groups = [g for g in c.groups if g.sensor == camera and g.name in c.lenses[camera]]
    if len(groups) < len(c.lenses[camera]) or all(g.columns is None for g in groups):
        return None
    projection = projection_uncertainty(c, camera)
    return None if projection is None else projection.median_seen


def lens_verdict(c: Calibration, camera: str) -> Verdict:
    """Verdict on a lens: its projection uncertainty compared with `pixel_tolerance` of the settings."""
    sigma = lens_projection_px(c, camera)
    verdicts = {v for g in c.groups if g.sensor == camera and g.name in c.lenses[camera] for v in g.verdict}
    if sigma is None:
        return "fixed"
    return component_verdict(sigma / tolerance(c, "pixel_tolerance"), "unobservable" in verdicts)


def tolerance(c: Calibration, name: str) -> float:
    """The setting `name` of the rig file, a tolerance, in the unit of that field; the default if `c` has no
    settings."""
    return float(c.settings.get(name, getattr(Settings, name)))


def counted(c: Calibration, g: ParameterGroup) -> tuple[Verdict, ...]:
    """Verdicts of a group that contribute to the verdict on the result; one verdict for a lens, none for nuisance
    parameters."""
    if g.name in AUXILIARY:
        return ()
    if g.name in c.lenses.get(g.sensor, ()):
        return (lens_verdict(c, g.sensor),) if {"weak", *UNUSABLE} & {*g.verdict} else ()
    return () if g.mode == "prior" else g.verdict


def _named(c: Calibration, *verdicts: Verdict) -> Iterator[Remark]:
    """Sentences on the components that have each of `verdicts`: first those whose standard deviation comes from the
    prior on IMU intrinsics or from effects that the estimate leaves out, then all others but those that the sentence
    on an unobservable direction names."""
    by_prior = f"{c.imu}.intrinsics"
    for verdict in verdicts:
        components = [(name, source) for name, v, source in _components(c) if v == verdict]
        of = {source: [name for name, by in components if by == source] for _, source in components}
        what = _MEANINGS[verdict].split(";")[0]
        for source in sorted(of.keys() & c.effects.keys()):
            effect = source.partition(".")[2].replace("_", " ")
            yield Remark(
                "effect_limits",
                f"{named_few(of[source])}: {what}; so much of it comes from the {effect} of {source.split('.')[0]}, "
                "which the estimate leaves out: let it be estimated.",
            )
        if by_prior in of and by_prior not in c.effects:
            prior = prior_words(np.array(c.rig["sensors"][c.imu]["intrinsics"]["sigma"]))
            yield Remark(
                "imu_prior_limits",
                f"{named_few(of[by_prior])}: {what}; so much of it comes from the prior on IMU "
                f"intrinsics {prior}. State the class of {c.imu} (`intrinsics: industrial` or "
                "`intrinsics: tactical`), or "
                "`intrinsics: fixed` if it is calibrated.",
            )
        names = of.get("", [])
        if verdict == "unobservable":
            names = [name for name in names if not any(name.split(" (")[0] in words for words in c.unobservable)]
        if names:
            meaning = _MEANINGS[verdict]
            yield meaning.with_sentence(f"{named_few(names)}: {meaning.format(more=_more(c))}.")


def _more(c: Calibration) -> str:
    """Advice for this rig: what to record so that standard deviations become smaller."""
    if any(SENSOR_TYPES[s["type"]].drives for s in c.rig["sensors"].values()):
        return "drive longer, with turns both ways, and brake and speed up"
    if c.imu is None and c.lenses:
        images = sum(len(r.seconds) for r in c.image_residuals)
        return f"the result rests on {images} images: take more, near and far, tilted, and in every part of the image"
    axes = hardly_turned(c.trajectory.seconds, c.trajectory.rotation, c.reference)
    if c.imu is None:
        return f"record more poses, turned about {axes or 'every axis'}"
    return f"record longer, and {f'turn the rig about {axes}' if axes else 'turn about and move along every axis'}"


def _components(c: Calibration) -> Iterator[tuple[str, Verdict, str]]:
    """Name with standard deviation, verdict, and what contributes most of the variance, of every component that
    contributes to the verdict on the result: the prior on IMU intrinsics, an effect, or neither (empty)."""
    sources = [*c.effects]
    if c.imu is not None and "sigma" in c.rig["sensors"][c.imu].get("intrinsics", ()):  # a prior, not `fixed`
        sources.append(f"{c.imu}.intrinsics")
    for g in c.groups:
        verdicts = counted(c, g)
        if g.name in (lens := c.lenses.get(g.sensor, ())):
            if verdicts and g.name == lens[0]:
                yield f"{g.sensor} lens (projection {lens_projection_px(c, g.sensor):.2g} px)", verdicts[0], ""
            continue
        unit, scale = display_unit(g.unit)
        for k, (label, verdict) in enumerate(zip(g.labels, verdicts, strict=False)):
            parts = {by: float(g.std_by[by][k]) for by in sources if by in g.std_by}
            source, std = max(parts, key=lambda by: parts[by], default=""), float(g.std[k])
            source = source if parts.get(source, 0.0) ** 2 > _MOST_BY_ONE * std**2 else ""
            size = (
                f"{scale * parts[source]:.2g} of {scale * std:.2g} {unit}"
                if source
                else f"std {scale * std:.2g} {unit}"
            )
            yield f"{component_name(g, label)} ({size.strip()})", verdict, source


def component_name(g: ParameterGroup, label: str) -> str:
    """Words for one number of a group, such as "cam0 rotation x"."""
    return f"{g.sensor} {g.name if label in (g.name, '') else f'{g.name} {label}'}".replace("_", " ")


def named_few(names: list[str]) -> str:
    """The first of `names`, and how many more there are."""
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more

"""The verdict: the worst that applies, one for console, report, files and exit code."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.remarks import remark

from icalib.cli import main
from icalib.cli.console import print_result, print_warnings
from icalib.observability.prior_sensitivity import Effect
from icalib.report import report_html
from icalib.result import Calibration, load_calibration, relative_pose, verdict
from icalib.result.quantities import rows
from icalib.result.verdict import EXIT_CODES, NEXT, component_verdict, lens_projection_px
from icalib.sensors.imu.spec import ACCEL_DELAY, class_imperfections
from icalib.validation.assess import unseen_notes

LARGE = remark("it is too large.")


def with_verdicts(c: Calibration, verdict: str, where: tuple[str, ...] = ()) -> Calibration:
    """All components determined, but those of the groups named `where`."""
    groups = tuple(
        dataclasses.replace(g, verdict=(verdict if g.name in where else "determined",) * len(g.verdict))
        if g.columns
        else g
        for g in c.groups
    )
    return dataclasses.replace(c, unobservable=(), warnings=(), groups=groups)


@pytest.fixture(scope="module")
def cases(calibration: Calibration) -> dict[str, Calibration]:
    """By name; each name begins with the verdict."""
    sound = with_verdicts(calibration, "determined")
    wrong = {"warnings": (remark("mind."), LARGE), "wrong": (LARGE,)}
    return {
        "usable": sound,
        "usable: coefficients trade, the projection is known": with_verdicts(calibration, "weak", ("distortion",)),
        "usable: nuisances": with_verdicts(calibration, "unobservable", ("bloom", "shape", "tilt")),
        "usable with care: weak": with_verdicts(calibration, "weak", ("translation",)),
        "usable with care: warned": dataclasses.replace(sound, warnings=(remark("mind."),)),
        "partly usable: open": with_verdicts(calibration, "unobservable", ("translation",)),
        "partly usable: too uncertain": with_verdicts(calibration, "too uncertain", ("translation",)),
        "partly usable": calibration,
        "not usable: wrong": dataclasses.replace(sound, **wrong),
        "not usable: wrong and open": dataclasses.replace(calibration, **wrong),
        "not usable: failed": dataclasses.replace(calibration, converged=False),
    }


def console_of(c: Calibration, verbose: bool = False) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        print_result(c, Path("out"), verbose)
    return " ".join(out.getvalue().split())


def test_a_long_output_begins_with_verdict_and_first_reason(cases: dict[str, Calibration], monkeypatch):
    """And its legend says what the words of the table mean."""
    c = cases["not usable: wrong and open"]
    monkeypatch.setenv("LINES", "5")
    shown = console_of(c, verbose=True)
    assert shown.startswith(f"Verdict: {c.verdict}. {NEXT[c.verdict]} Reason 1 of {len(c.reasons)}: {c.reasons[0]}")
    assert shown.endswith(f"Verdict: {c.verdict}. {NEXT[c.verdict]}") and "bloom: dark edges" in shown
    monkeypatch.setenv("LINES", "500")
    assert console_of(c).startswith("Calibration")


def test_single_coefficients_of_a_lens_come_after_its_projection(calibration: Calibration):
    """Its verdict is that of the projection."""
    weak = with_verdicts(calibration, "weak", ("translation",))
    c = dataclasses.replace(weak, unobservable=(remark("cam0 intrinsics fx: ..."),))
    assert c.verdict == "usable with care"
    assert "weakly determined" in c.reasons[-2] and c.reasons[-1] == "cam0 intrinsics fx: ..."


def test_the_worst_that_applies_is_the_verdict(cases: dict[str, Calibration]):
    assert {name: c.verdict for name, c in cases.items()} == {name: name.split(":")[0] for name in cases}
    assert {c.verdict for c in cases.values()} == set(EXIT_CODES) == set(NEXT)


def test_every_place_says_the_same(cases: dict[str, Calibration], tmp_path: Path):
    for name, c in cases.items():
        folder = tmp_path / str(len(name))
        c.save(folder)
        read, named = json.loads((folder / "result.json").read_text()), [{r.name: r} for r in c.reasons]
        assert (read["verdict"], tuple(read["reasons"])) == (c.verdict, c.reasons)
        read = yaml.safe_load((folder / "calibration.yaml").read_text())
        assert (read["verdict"], read["reasons"]) == (c.verdict, named)
        again = load_calibration(folder)
        assert (again.verdict, again.reasons) == (c.verdict, c.reasons)
        assert console_of(c).endswith(f"Verdict: {c.verdict}. {NEXT[c.verdict]}")
        assert f"{c.verdict.capitalize()}. {NEXT[c.verdict]}" in report_html(c)


def test_what_must_be_wrong_is_the_first_reason(cases: dict[str, Calibration]):
    assert cases["not usable: wrong"].reasons == ("it is too large.", "mind.")
    words = cases["not usable: wrong and open"]
    assert words.reasons[:2] == ("it is too large.", words.unobservable[0]) and "mind." in words.reasons
    assert cases["not usable: failed"].reasons[0].startswith("the solver did not converge")
    assert (cases["usable"].reasons, cases["usable: nuisances"].reasons) == ((), ())


def test_components_are_named_where_no_direction_is(cases: dict[str, Calibration]):
    (weak,) = cases["usable with care: weak"].reasons
    assert weak.startswith("cam0 translation x (std 1.1 mm), cam0 translation y (std 1.2 mm)")
    (open_one,) = cases["partly usable: open"].reasons
    assert "cam1 translation z" in open_one and "unobservable" in open_one and "initial guess" in open_one
    (uncertain,) = cases["partly usable: too uncertain"].reasons
    assert "cam1 translation z" in uncertain and "exceeds ten tolerances" in uncertain and "guess" not in uncertain


def test_every_component_of_a_bad_verdict_is_in_the_reasons(calibration: Calibration):
    """A sentence on one direction hides neither other unobservable components nor those that are too uncertain."""
    verdicts = {"rotation": "unobservable", "translation": "too uncertain", "time_offset": "weak"}
    groups = tuple(
        dataclasses.replace(g, verdict=(verdicts[g.name],) * len(g.verdict)) if g.name in verdicts else g
        for g in calibration.groups
    )
    directions = (remark("cam0 rotation x with cam1 rotation x: not determined by this motion; turn."),)
    found = dataclasses.replace(calibration, groups=groups, unobservable=directions, warnings=())
    direction, rest, uncertain, weak = found.reasons
    assert direction == directions[0] and "cam0 rotation x" not in rest and "cam0 rotation y" in rest
    assert "cam0 translation x" in uncertain and "cam1 time offset" in weak


@pytest.mark.parametrize("verdict", ["weak", "too uncertain"])
def test_the_prior_of_the_imu_is_named_before_motion_is_asked_for(calibration: Calibration, verdict: str):
    """Where it contributes most of the variance: here of cam0, not of cam1."""
    c, share = with_verdicts(calibration, verdict, ("rotation",)), {"cam0": 0.8, "cam1": 0.6}
    groups = tuple(
        dataclasses.replace(g, std_by={"imu0.intrinsics": share[g.sensor] * g.std}) if g.name == "rotation" else g
        for g in c.groups
    )
    intrinsics = {"prior": [0.0] * 24, "sigma": class_imperfections("consumer").sigma.tolist()}
    sensors = c.rig["sensors"] | {"imu0": c.rig["sensors"]["imu0"] | {"intrinsics": intrinsics}}
    first, second = dataclasses.replace(c, groups=groups, rig=c.rig | {"sensors": sensors}).reasons
    std = np.rad2deg(c.group("cam0", "rotation").std[0])
    assert first.startswith(f"cam0 rotation x ({0.8 * std:.2g} of {std:.2g} deg), cam0 rotation y")
    assert "prior on IMU intrinsics of a consumer IMU" in first and "`intrinsics: fixed`" in first
    assert "record" not in first and "cam1" not in first
    assert second.startswith("cam1 rotation x (std") and "record longer" in second


def test_an_imu_that_may_not_be_ideal_is_no_prior(calibration: Calibration):
    """Standard deviations cover intrinsics that the rig file fixes, and there is no prior to name."""
    c = with_verdicts(calibration, "weak", ("rotation",))
    by_imu = (dataclasses.replace(g, std_by={"imu0.intrinsics": 0.9 * g.std}) for g in c.groups)
    sensors = c.rig["sensors"] | {"imu0": c.rig["sensors"]["imu0"] | {"intrinsics": "fixed"}}
    (reason,) = dataclasses.replace(c, groups=tuple(by_imu), rig=c.rig | {"sensors": sensors}).reasons
    assert reason.startswith("cam0 rotation x (std") and "record longer" in reason


def test_what_makes_up_most_of_a_standard_deviation_is_noted(calibration: Calibration):
    g = calibration.group("cam0", "time_offset")
    std = 1e3 * g.std[0]
    most, less = (dataclasses.replace(g, std_by={"board0.size": share * g.std}) for share in (0.8, 0.7))
    (note,) = unseen_notes([most, less], [])
    assert (
        f"the size of board0, which makes up most of the standard deviation of cam0 time offset ({0.8 * std:.2g} of"
        in note
    )
    assert not list(unseen_notes([less], []))


def test_an_effect_that_makes_up_most_of_a_standard_deviation_is_noted(calibration: Calibration):
    g = calibration.group("cam0", "time_offset")
    delay = Effect("imu0", ACCEL_DELAY, np.array([1e-3]), np.array([[3e-4]]), 11.0, 0.5)
    (note,) = unseen_notes([dataclasses.replace(g, std_by={"imu0.accel_delay": 0.8 * g.std})], [delay])
    assert note.startswith("the accel delay of imu0 may differ from zero")


def test_a_lens_is_judged_by_its_projection(calibration: Calibration):
    """Coefficients that are called weak do not count while the projection is known; with a tolerance below its
    uncertainty they do."""
    sigma = lens_projection_px(calibration, "cam0")
    found = with_verdicts(calibration, "weak", ("intrinsics",))
    assert sigma is not None and found.verdict == "usable"
    strict = dataclasses.replace(found, settings=found.settings | {"pixel_tolerance": 0.5 * sigma})
    assert strict.verdict == "usable with care"
    assert f"cam0 lens (projection {sigma:.2g} px)" in strict.reasons[0]


def test_the_projection_of_a_lens_is_found_once(calibration: Calibration, monkeypatch: pytest.MonkeyPatch):
    asked = []
    find = verdict.projection_uncertainty
    monkeypatch.setattr(verdict, "projection_uncertainty", lambda c, camera: asked.append(camera) or find(c, camera))
    found = with_verdicts(calibration, "weak", ("intrinsics",))
    assert found.verdict == "usable" and found.reasons == () and report_html(found)
    assert sorted(asked) == sorted(set(asked)) and "cam0" in asked


def test_a_prior_that_the_data_do_not_improve_is_no_reason(calibration: Calibration):
    found = with_verdicts(calibration, "unobservable", ("time_offset",))
    assert found.verdict == "partly usable"
    groups = tuple(dataclasses.replace(g, mode="prior") if g.name == "time_offset" else g for g in found.groups)
    assert dataclasses.replace(found, groups=groups).verdict == "usable"


def test_verdicts_without_weight_are_in_brackets(cases: dict[str, Calibration], calibration: Calibration):
    """So that no table contradicts the verdict on the result: nuisances, priors, and coefficients of a lens that
    projects well; the caption says so."""
    prior = tuple(
        dataclasses.replace(g, mode="prior", verdict=("weak",)) if g.name == "time_offset" else g
        for g in cases["usable"].groups
    )
    lens = "usable: coefficients trade, the projection is known"
    cases = cases | {"usable: prior": dataclasses.replace(cases["usable"], groups=prior)}
    cases |= {lens: with_verdicts(calibration, "weak", ("intrinsics",))}
    for name, c in cases.items():
        found = {r.verdict for r in rows(c)} - {"", "determined", "fixed"}
        bracketed = {v for v in found if v.startswith("(")}
        assert (c.verdict == "usable" or bool(c.warnings)) or found - bracketed, name
        assert c.verdict != "usable" or found == bracketed, name
        assert ("In brackets: without weight" in console_of(c, verbose=True)) == bool(bracketed), name
    assert {r.verdict for r in rows(cases["usable: prior"]) if r.name == "time offset"} == {"(weak)"}
    assert {r.verdict for r in rows(cases[lens]) if r.name == "fx"} == {"(weak)"}


def test_quiet_leaves_warnings_on_standard_error(cases: dict[str, Calibration], capsys: pytest.CaptureFixture[str]):
    print_warnings(cases["usable with care: warned"])
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("Reason 1: mind.\nVerdict: usable with care.")
    print_warnings(cases["usable"])
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("size", "verdict"),
    [(1.0, "determined"), (1.01, "weak"), (10.0, "weak"), (95.0, "too uncertain"), (np.nan, "too uncertain")],
)
def test_a_component_is_judged_by_its_printed_size(size: float, verdict: str):
    """Above ten tolerances it is unobservable if the guess is most of its variance."""
    assert component_verdict(size) == verdict
    assert component_verdict(size, by_guess=True) == verdict.replace("too uncertain", "unobservable")


def test_the_baseline_is_that_of_samples(calibration: Calibration):
    """Distances between translations drawn from the relative pose's covariance."""
    r = relative_pose(calibration, "cam0", "cam1")
    drawn = np.random.default_rng(4).multivariate_normal(r.T[:3, 3], r.covariance[3:, 3:], 20_000)
    assert r.distance == pytest.approx(np.linalg.norm(r.T[:3, 3]))
    assert r.distance_std == pytest.approx(np.linalg.norm(drawn, axis=1).std(), rel=0.03)
    assert f"baseline {1e3 * r.distance:.2f} +- " in console_of(calibration)


@pytest.mark.parametrize("flags", [[], ["-q"], ["-v"]])
def test_the_exit_code_of_strict(
    cases: dict[str, Calibration],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    flags: list[str],
):
    """Without --strict 0, whatever the verdict; with it that of the verdict. The board's shape is printed by -v."""
    rig = tmp_path / "rig.yaml"
    rig.write_text((Path(__file__).parents[2] / "examples" / "euroc" / "rig.yaml").read_text())
    monkeypatch.setattr("icalib.export.formats.write_outputs", lambda *_: None)
    command = ["calibrate", str(rig), str(tmp_path / "run"), "-o", str(tmp_path / "out"), *flags]
    for name in ("usable", "usable with care: weak", "partly usable", "not usable: wrong"):
        monkeypatch.setattr("icalib.pipeline.calibrate", lambda *_, c=cases[name], **__: c)
        assert main(command) == 0
        assert main([*command, "--strict"]) == EXIT_CODES[cases[name].verdict]
        assert ("shape bow xx" in capsys.readouterr().out) == (flags == ["-v"])
    assert list(EXIT_CODES.values()) == [0, 3, 4, 5]

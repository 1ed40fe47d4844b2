"""Numbers that the documentation states are those of the program."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path

from tests.cases import each

from icalib.rig.rig import Settings
from icalib.sensors.camera import inspect as camera
from icalib.sensors.camera.assess import lenses
from icalib.sensors.imu import inspect as imu
from icalib.sensors.lidar.spec import Lidar
from icalib.sensors.pose.spec import PoseSensor
from icalib.tools.comparison.compare import DEFAULT_TOLERANCES
from icalib.validation import guesses

DOCS = Path(__file__).parents[1] / "docs"
T = DEFAULT_TOLERANCES
STATED = [
    ("compare.md", f"{T['deg']:g} deg, {T['mm']:g} mm, {T['ms']:g} ms, {T['px']:g} px and {T['percent']:g} %"),
    ("uncertainty.md", f"More than {guesses.WRONG:.0%} and {guesses.CLEARLY:g} standard deviations"),
    ("uncertainty.md", f"more than {guesses.BEYOND:.0%} is `not usable`"),
    ("faq.md", f"shows those from {guesses.WRONG:.0%} on"),
    ("record.md", f"[from {guesses.WRONG:.0%}]"),
    ("estimator.md", f"at most {lenses.MOST_IMAGES} parts"),
    ("estimator.md", f"a sign test over images at {lenses.SIGN_TEST_SIGMAS:g} sigma"),
    ("inspect.md", f"in less than {camera.LEAST_SHARE:.0%} of the images"),
    ("inspect.md", f"tilted by more than {camera.FLAT_DEG:g} deg"),
    ("inspect.md", f"below {imu.STILL_RAD_S:g} rad/s RMS;"),
    ("inspect.md", f"below {imu.WEAK_RAD_S:g} rad/s RMS about some direction"),
    ("inspect.md", f"above {imu.FASTEST_RAD_S:g} rad/s"),
    ("inspect.md", f"about one axis only: {imu.SECOND_AXIS:.0%} of it"),
    ("inspect.md", f"less than {imu.SHORT_S:g} s"),
    ("rig-file.md", f"| `min_range`, `max_range` | {Lidar.min_range_m:g}, {Lidar.max_range_m:g} |"),
    ("rig-file.md", f"| `scale_sigma` | {PoseSensor.scale_sigma:g} |"),
]


def page(name: str) -> str:
    """The text of a page, in one line, with percent as in Python's format."""
    return re.sub(r"(\d) %", r"\1%", " ".join((DOCS / name).read_text(encoding="utf-8").split()))


@each(("name", "words"), STATED)
def test_a_page_states_the_number_of_the_program(name: str, words: str):
    assert words.replace(" %", "%") in page(name)


def test_the_table_of_settings_has_the_defaults():
    text = (DOCS / "rig-file.md").read_text(encoding="utf-8").split("\n## Settings\n")[1]
    table = dict(re.findall(r"^\| `(\w+)` \| `?([^|`]+)`? \|", text, re.MULTILINE))
    defaults = {name: f"{value}".lower() for name, value in asdict(Settings()).items()}
    assert {name: value.lower() for name, value in table.items()} == defaults


def test_the_faq_and_the_tour_agree_on_the_corner_of_the_image():
    (of_tour,) = re.findall(r"In the top right corner it is (\d+) px", page("tour.md"))
    assert f"shows a corner of the image with {of_tour} px" in page("faq.md")

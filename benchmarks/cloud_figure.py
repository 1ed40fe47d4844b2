"""docs/cloud.jpg, points of a LiDAR in an image with right and wrong calibrations: python benchmarks/cloud_figure.py

The pictures are those of the report on a camera and a LiDAR that turn in a simulated room: as calibrated, and by a
first guess that is the result but for a time offset wrong by OFFSET_S, or a rotation wrong by TURN_DEG.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader
from tour_figures import installed_browser, shot

from icalib.data.measurements import Measurements, TrackStream
from icalib.geometry import so3
from icalib.pipeline import calibrate_measurements
from icalib.report.page import resource
from icalib.report.pictures import Drawing, figures
from icalib.result import Calibration
from icalib.result.calibration import ReportImage
from icalib.result.pictures import pictures
from icalib.tools.simulation import (
    Imaging,
    Obstacle,
    Room,
    Scenario,
    Simulation,
    Texture,
    film,
    load_scenario,
    rig_for,
    simulate,
)

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / "docs" / "cloud.jpg"
SEED, DURATION_S, IMAGES_HZ = 4, 12.0, 4.0
OFFSET_S, TURN_DEG = 0.03, 0.5
IMAGING = Imaging(white=255.0, black=0.0, background=110.0, blur_px=0.8, noise=2.0)
WIDTH, HEIGHT = 1290, 720  # px
PAGE = """{% from "report/parts.html" import shot %}<style>{{ css }}
body { display: block; background: #fff; color: #111; padding: 8px; }
.shots { grid-template-columns: repeat(3, 1fr); } figure { margin: 0; } figcaption { color: #111; font-size: 16px; }
</style><div class="shots">{% for drawing in drawings %}{{ shot(drawing) }}{% endfor %}</div>"""


def main() -> None:
    css = resource("icalib.report", "page.css")
    environment = Environment(loader=PackageLoader("icalib", "."), autoescape=False)
    text = environment.from_string(PAGE).render(css=css, drawings=list(panes()))
    image = shot(installed_browser(), text, (WIDTH, HEIGHT))
    rows = np.flatnonzero((np.asarray(image) != 255).any(axis=(1, 2)))
    image.crop((0, 0, WIDTH, int(rows[-1]) + 9)).save(FILE, quality=80, optimize=True)
    print(f"{FILE.name}: {FILE.stat().st_size / 1e3:.0f} kB")


def panes() -> Iterator[Drawing]:
    """Three pictures with an image of the fastest turn: right, wrong time offset, wrong rotation."""
    recording = simulate(scenario(), SEED)
    m, c = with_images(recording), calibrate_measurements(rig_for(recording.scenario), recording.measurements)
    rotation = c.group("lidar0", "rotation").value @ so3.exp(np.deg2rad([0.0, 0.0, TURN_DEG]))
    late = c.group("lidar0", "time_offset").value + OFFSET_S
    right = picture(replace(c, first_guess={}), m)
    yield replace(next(figures(replace(c, pictures=(right,)))), words=f"As calibrated, {right.title}", name="right")
    wrong = {"Time offset wrong by 30 ms": ("time_offset", late), "Rotation wrong by 0.5 deg": ("rotation", rotation)}
    for k, (words, (group, value)) in enumerate(wrong.items()):
        image = picture(replace(c, first_guess={("lidar0", group): value}), m)
        before = next(figures(replace(c, pictures=(image,))))
        yield replace(before, words=words, image=f"again-{k}", name=f"wrong-{k}")


def scenario() -> Scenario:
    """A camera and a LiDAR of 32 rings in a room with plain boxes."""
    table = load_scenario(ROOT / "examples" / "paper" / "table2-3d.yaml")
    at = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    blocks = tuple(
        Obstacle((4.5 * float(np.cos(a)), 3.7 * float(np.sin(a))), (0.5, 0.4, (1.1, 2.6, 1.9)[k % 3]), float(a))
        for k, a in enumerate(at)
    )
    lidar = replace(next(s for s in table.sensors if s.name == "lidar0"), rings=32, range_noise_m=0.02)
    room = Room(table.room.size, blocks, texture=Texture(seed=SEED, share=0.0))
    return replace(table, cameras=table.cameras[:1], sensors=(lidar,), room=room, duration_s=DURATION_S)


def with_images(recording: Simulation) -> Measurements:
    """The recording with some of its rendered images, as reading them from a bag keeps them for the report."""
    camera = replace(recording.scenario.cameras[0], rate_hz=IMAGES_HZ)
    shots = film(replace(recording.scenario, cameras=(camera,)), SEED, IMAGING).shots()
    kept = {s.stamp_ns: ("", cv2.imencode(".jpg", s.pixels)[1].tobytes()) for s in shots}
    streams = recording.measurements.streams
    tracks = {key: replace(x, pictures=kept) for key, x in streams.items() if isinstance(x, TrackStream)}
    return replace(recording.measurements, streams={**streams, **tracks})


def picture(c: Calibration, m: Measurements) -> ReportImage:
    """The LiDAR's points in the image of the fastest turn."""
    return next(p for p in pictures(c, ["lidar0"], [m]) if p.after)


if __name__ == "__main__":
    main()

"""Speed and yaw rate, and a driven wheel with front wheels that steer, on the obvious path: their rows and signs."""

from dataclasses import replace

import numpy as np
from tests.cases import each

from icalib.data.measurements import WheelStream
from icalib.optim.arrowhead import make_pieces
from icalib.optim.state import make_layout
from icalib.sensors.wheels.increment_kernels import coefficients
from icalib.sensors.wheels.residual import IncrementFactor, WheelNoise, integrals_of

DRIVES = {
    "twist": {"scales": np.array([1.1, 0.9])},
    "steered": {"radius": np.array([0.12]), "wheelbase": np.array([0.6]), "steering_offset": np.array([0.04])},
}
UNIT = WheelNoise(1.0, 1.0, 1.0, speed=1.0, yaw=1.0, steering=0.0)


def readings(drive, kind, t):
    """(n, 2) at t: by definition. The front axle moves to its left at wheelbase x yaw rate."""
    ahead, turning = drive.speed(t), drive.rate(t)[:, 2]
    if kind == "twist":
        return np.stack([ahead, turning], axis=1) / DRIVES[kind]["scales"]
    own = {name: value[0] for name, value in DRIVES[kind].items()}
    return np.stack(
        [ahead / own["radius"], np.arctan2(own["wheelbase"] * turning, ahead) - own["steering_offset"]], axis=1
    )


def world_with(world_of, drive, kind, hz=1000.0, **options):
    """The world with wheels of `kind` in its state, what they report at instants, and the stream of it."""
    world = world_of(drive, **options)
    offset = world.state.values["wheel0", "time_offset"][0]
    seconds = np.arange(0.0, drive.duration - 0.05, 1.0 / hz)
    stamps = np.round(seconds * 1e9).astype(np.int64)
    stream = WheelStream("wheel0", stamps, readings(drive, kind, seconds + offset), "instantaneous", kind)
    values = {k: v for k, v in world.state.values.items() if k[1] not in ("radii", "baseline")}
    values |= {("wheel0", name): v for name, v in DRIVES[kind].items()}
    entries = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in world.layout.blocks]
    entries = [e for e in entries if e[1] not in ("radii", "baseline")]
    entries += [("wheel0", name, "vector", len(v), True) for name, v in DRIVES[kind].items()]
    return replace(world, layout=make_layout(entries), state=replace(world.state, values=values)), stream


def forwards(drive_of_kind, waves, path="hills"):
    """A drive that never stands still, so that its front wheels can be steered, by up to 45 degrees."""
    return replace(
        drive_of_kind(path, 1), speed=waves(1.2, (0.5,), (0.3,), (0.2,)), yaw=waves(0.3, (1.3,), (0.2,), (0.1,))
    )


def factor_on(world, stream, noise=UNIT):
    return IncrementFactor.build(
        "wheel0", stream.seconds, integrals_of(stream), world.motion(), noise, world.layout, stream.kind
    )


def rows(factor, state):
    """(n, 4) before whitening."""
    out = factor.output()
    for piece in make_pieces(len(state.seconds), factor.layout.size):
        factor.accumulate(state, piece, out, sums=False)
    return out.residual / np.diagonal(factor.whitening, axis1=1, axis2=2)


# On hills the logarithm of a rotation is not the integral of its rate; and everywhere the mean of a product is not the
# product of means, which leaves d(angle) d(speed) dt / 12 of the steering row.
@each(("path", "rest", "slip"), [("planar", 1e-6, 1e-8), ("hills", 4e-5, 4e-6)])
@each("kind", DRIVES)
def test_residuals_vanish_on_a_path_without_slip(drive_of_kind, world_of, waves, kind, path, rest, slip):
    world, stream = world_with(world_of, forwards(drive_of_kind, waves, path), kind)
    r = np.abs(rows(factor_on(world, stream), world.state))
    assert len(r) > 70 and np.abs(stream.rate[:, 1]).max() > 0.3
    assert r[:, 0].max() < rest and r[:, 1].max() < (2e-5 if kind == "steered" else rest) and r[:, 2:].max() < slip


@each(
    ("kind", "name", "step", "row"),
    [
        ("twist", "scales", [0.01, 0.0], 0),
        ("twist", "scales", [0.0, 0.01], 1),
        ("steered", "radius", [0.001], 0),
        ("steered", "wheelbase", [0.01], 1),
        ("steered", "steering_offset", [0.01], 1),
    ],
)
def test_a_wrong_parameter_shows_in_its_own_row_alone(drive_of_kind, world_of, waves, kind, name, step, row):
    """By how much: speeds and yaw rates that are s too small are too small by s of what they measure, a front axle that
    is dL too far ahead moves dL sin(turn) to the side, and wheels steered by dd too much take it v dd there."""
    world, stream = world_with(world_of, forwards(drive_of_kind, waves, "planar"), kind)
    factor = factor_on(world, stream)
    change = rows(factor, world.moved(**{name: np.array(step)})) - rows(factor, world.state)
    assert np.abs(np.delete(change, row, axis=1)).max() < 1e-12
    middle = stream.seconds[factor.intervals.first] + 0.0123
    dt = stream.seconds[factor.intervals.last] - stream.seconds[factor.intervals.first]
    drive = world.drive
    t = middle + 0.5 * dt
    angle = np.arctan2(0.6 * drive.rate(t)[:, 2], drive.speed(t))
    expected = {
        "scales": -0.01 / (1.1**2 if row == 0 else 0.9**2) * (drive.speed(t) if row == 0 else drive.rate(t)[:, 2]),
        "radius": -0.001 / 0.12**2 * drive.speed(t),
        "wheelbase": 0.01 * np.cos(angle) * drive.rate(t)[:, 2],
        "steering_offset": -0.01 * drive.speed(t) / np.cos(angle),
    }[name] * dt
    np.testing.assert_allclose(change[:, row], expected, rtol=0.02, atol=2e-6)


def test_the_steering_row_is_whitened_by_the_way_of_the_front_axle(drive_of_kind, world_of, waves):
    world, stream = world_with(world_of, forwards(drive_of_kind, waves), "steered")
    noise = WheelNoise(0.02, 3e-3, 7e-3, steering=0.01)
    factor = factor_on(world, stream, noise)
    first, last = factor.intervals.first, factor.intervals.last
    dt = stream.seconds[last] - stream.seconds[first]
    speed = 0.12 * stream.rate[:, 0] / np.cos(stream.rate[:, 1])
    square = np.array([np.mean(speed[a:b] ** 2) for a, b in zip(first, last, strict=True)])
    expected = np.sqrt((3e-3**2 + 0.01**2 * square) * dt)
    np.testing.assert_allclose(1.0 / factor.whitening[:, 1, 1], expected, rtol=2e-3)
    np.testing.assert_allclose(1.0 / factor.whitening[:, 0, 0], 0.02 * np.sqrt(dt), rtol=1e-12)


@each(("kind", "drive"), [("pair", [0.1, 0.12, 0.5]), ("twist", [1.1, 0.9, 0.0]), ("steered", [0.1, 0.6, 0.3])])
def test_derivatives_of_the_coefficients(kind, drive):
    """The last parameter is the unit of length."""
    rng, drive = np.random.default_rng(0), np.array([*drive, 1.3])
    mean = rng.uniform(0.1, 0.9, (3, 3))
    made = coefficients(kind, drive, mean)
    assert np.abs(made.J_g_X).max() + np.abs(made.J_g_T).max() > 0.1
    for k in (0, 1, 3) if kind == "twist" else range(4):
        up, down = (coefficients(kind, drive + s * 1e-6 * np.eye(4)[k], mean) for s in (1.0, -1.0))
        np.testing.assert_allclose(made.J_g_X[:, :, k], (up.g_X - down.g_X) / 2e-6, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(made.J_g_T[:, :, k], (up.g_T - down.g_T) / 2e-6, rtol=1e-7, atol=1e-7)

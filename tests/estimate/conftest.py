"""The estimator's problem on short recordings."""

from tests.setups import (  # noqa: F401 fixtures
    dense,
    factor_of,
    features_of,
    features_on_planes,
    problem_of,
    robot_scenario,
    room_of,
    setup_of,
    sparse_room,
    unlike,
)

"""A short noiseless recording."""

from tests.setups import setup_of, unlike  # noqa: F401 fixtures

"""Normal equations as dense matrices."""

from tests.setups import dense  # noqa: F401 fixtures

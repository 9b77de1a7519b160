import pytest
from linear_world import linear_world


@pytest.fixture(scope="session")
def world():
    """The equations of a small linear world, which no test changes."""
    return linear_world()

"""The world that most tests of the evaluation use."""

from __future__ import annotations

import pytest
from scored import World, make_world


@pytest.fixture
def world() -> World:
    return make_world()

"""One short recording's episodes and messages for every test; made once."""

from __future__ import annotations

import pytest
from bag_maker import Made, Team, played


@pytest.fixture(scope="session")
def team() -> Team:
    return Team()


@pytest.fixture(scope="session")
def made(team: Team) -> list[Made]:
    return played(team, 6)

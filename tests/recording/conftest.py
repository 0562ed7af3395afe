"""A place for a recording, and a bus whose time stands still."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tfbus import Bus, SimulatedClock


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


@pytest.fixture
def bus() -> Iterator[Bus]:
    with Bus(SimulatedClock()) as bus:
        yield bus

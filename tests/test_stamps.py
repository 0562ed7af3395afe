import pytest

from tfbus import from_seconds


def test_seconds_become_whole_nanoseconds() -> None:
    assert from_seconds(1.5) == 1_500_000_000


@pytest.mark.anyio
async def test_every_async_test_runs_on_every_loop() -> None: ...

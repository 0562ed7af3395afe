import os
import sys
from pathlib import Path

import pytest

from tfbus.links.zenoh._lease import default_lease


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file like Linux's `/proc/loadavg`, of a machine with four CPUs."""
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    return tmp_path / "loadavg"


@pytest.mark.parametrize(("runnable", "lease"), [(1, 4.0), (32, 4.0), (33, 10.0), (1_000, 10.0)])
def test_the_lease_is_longer_where_more_than_eight_threads_for_each_cpu_are_runnable(
    load: Path, runnable: int, lease: float
) -> None:
    load.write_text(f"99.00 99.00 99.00 {runnable}/2000 17843\n")
    assert default_lease(load) == lease


def test_without_the_number_of_cpus_there_is_one(load: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    load.write_text("0.00 0.00 0.00 9/2000 17843\n")
    assert default_lease(load) == 10.0


@pytest.mark.parametrize("text", [None, "", "0.00 0.00 0.00", "0.00 0.00 0.00 many/2000 1", "\xff"])
def test_no_machine_is_busy_that_does_not_tell(load: Path, text: str | None) -> None:
    if text is not None:
        load.write_text(text, "latin-1")
    assert default_lease(load) == 4.0


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells how many threads are runnable")
def test_linux_tells_how_many_threads_are_runnable(monkeypatch: pytest.MonkeyPatch) -> None:
    # However few there are, they are more than that.
    monkeypatch.setattr(os, "cpu_count", lambda: -1)
    assert default_lease() == 10.0

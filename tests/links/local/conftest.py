import tempfile
from collections.abc import Iterator

import pytest


@pytest.fixture
def directory() -> Iterator[str]:
    """A directory of the user with a short path, which addresses of Unix sockets need."""
    with tempfile.TemporaryDirectory(prefix="tfbus-", ignore_cleanup_errors=True) as made:
        yield made


@pytest.fixture(params=[False, pytest.param(True, marks=pytest.mark.thorough)], ids=["unix", "loopback"])
def loopback(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)

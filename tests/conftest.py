"""Every async test runs on asyncio, on asyncio with uvloop, and on trio; no example of hypothesis has a deadline."""

import os
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import anyio
import pytest
from hypothesis import settings

# The same examples for every change that is to land; new ones wherever else the tests run.
settings.register_profile("tfbus", deadline=None, derandomize="CI" in os.environ)
settings.load_profile("tfbus")

T = TypeVar("T")
Backend = tuple[str, dict[str, Any]]

BACKENDS = [
    pytest.param(("asyncio", {}), id="asyncio"),
    pytest.param(("asyncio", {"use_uvloop": True}), id="uvloop"),
    pytest.param(("trio", {}), id="trio"),
]


@pytest.fixture(params=BACKENDS)
def anyio_backend(request: pytest.FixtureRequest) -> Backend:
    backend: Backend = request.param
    return backend


@pytest.fixture
def run(anyio_backend: Backend) -> Callable[[Callable[[], Awaitable[T]]], T]:
    """Run an async function to its end on the backend: for tests that need a fresh event loop for each example."""
    name, options = anyio_backend

    def run_on_backend(function: Callable[[], Awaitable[T]]) -> T:
        return anyio.run(function, backend=name, backend_options=options)

    return run_on_backend

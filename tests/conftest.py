"""Two suites, three event loops and two profiles of hypothesis.

``pytest`` runs the default suite. ``pytest -m thorough`` runs the rest: the slow tests, which are marked `thorough`.
``pytest -m ""`` runs both. A test that is named (``pytest file.py::test``) runs, marked or not.

An async test runs on asyncio in the default suite, and on asyncio with uvloop and on trio in the thorough one. One that
is marked `every_loop` runs on all three in the default suite.

A test of hypothesis is in both suites: with a few examples, always the same, in the default one; with more examples in
the thorough one, new ones at each run unless the variable `CI` is set. ``--hypothesis-profile`` chooses otherwise:
``default`` or ``thorough``.

Folders are tested by one process more than there are cores, because many tests wait for a process or a network, and
by four at most; single files and benchmarks by one. ``-n`` chooses otherwise.

A test, or a file of tests, that needs an extra which is not installed is skipped with the name of the extra.
"""

import gc
import logging
import os
import signal
from collections.abc import Awaitable, Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import anyio
import pytest
from hypothesis import HealthCheck, configuration, is_hypothesis_test, settings
from support.extras import absent_extra

import tfbus
from tfbus import Buffer, Bus, SimulatedClock

T = TypeVar("T")
Backend = tuple[str, dict[str, Any]]

ASYNCIO: Backend = ("asyncio", {})
BACKENDS = [
    pytest.param(ASYNCIO, id="asyncio"),
    pytest.param(("asyncio", {"use_uvloop": True}), id="uvloop"),
    pytest.param(("trio", {}), id="trio"),
]
DEFAULT_SUITE = "not thorough"
"""The expression of marks that pyproject.toml gives."""

LIMIT, THOROUGH_LIMIT = 60.0, float(os.environ.get("THOROUGH_LIMIT", "280"))
"""The longest that a test of each suite may take, in s; benchmarks have the time of thorough tests."""

MORE_EXAMPLES = int(os.environ.get("EXAMPLES", "50"))
"""The examples that the thorough suite takes in each test of hypothesis."""

EXAMPLES = settings(deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("default", EXAMPLES, max_examples=10, derandomize=True)
settings.register_profile("thorough", EXAMPLES, max_examples=MORE_EXAMPLES, derandomize="CI" in os.environ)


# The garbage collector may find a link that a test has made and not entered during any later test.
logging.getLogger("tfbus").addFilter(lambda record: "was made and never entered" not in record.getMessage())

# Commands would take it for the width of their output. pytest-xdist sets it in its workers, and readline in the
# environment of C only, of which `os.environ` knows nothing and programs inherit it all the same.
os.environ.pop("COLUMNS", None)
os.unsetenv("COLUMNS")


def is_default_suite(config: pytest.Config) -> bool:
    return bool(config.option.markexpr == DEFAULT_SUITE)


def pytest_configure(config: pytest.Config) -> None:
    if is_default_suite(config) and all("::" in argument for argument in config.args):
        config.option.markexpr = ""
    settings.load_profile("default" if is_default_suite(config) else "thorough")
    keep_tables_of_hypothesis_elsewhere()
    hear_ctrl_c()


def keep_tables_of_hypothesis_elsewhere() -> None:
    """Have hypothesis write to a cache of the user what it would write to the checkout.

    These are the tables of Unicode and the constants of all modules, which take each process some seconds to collect.
    """
    caches = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    configuration.set_hypothesis_home_dir(Path(caches, "tfbus-hypothesis"))


def hear_ctrl_c() -> None:
    """Undo that a script's background job, and each process that it starts, ignores Ctrl-C."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_report_header(config: pytest.Config) -> list[str]:
    suite = "default; -m thorough runs the rest" if is_default_suite(config) else f"-m {config.option.markexpr!r}"
    return [f"suite: {suite}", f"tfbus: {Path(tfbus.__file__).parent}"]


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """None but this one for single files, and for benchmarks, which would disturb each other."""
    paths = [Path(argument.partition("::")[0]) for argument in config.args]
    alone = all(path.is_file() or path.name == "benchmarks" for path in paths)
    return 0 if alone else min((os.cpu_count() or 1) + 1, 4)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Spare the garbage collector all that is imported and collected: it would walk through it again in every test.

    It also comes more seldom, and so does not walk through the same samples of a test again and again.
    """
    gc.disable()
    done = yield
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)
    gc.enable()
    return done


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what the thorough suite has beside the tests that are marked in their files."""
    for item in items:
        more_examples = not is_default_suite(config) and is_hypothesis_test(getattr(item, "obj", None))
        if more_examples or is_on_another_loop(item):
            item.add_marker("thorough")


def is_on_another_loop(item: pytest.Item) -> bool:
    """Whether an item runs a test on a loop that is not for the default suite."""
    parameters = item.callspec.params if hasattr(item, "callspec") else {}
    every_loop = item.get_closest_marker("every_loop") is not None
    return not every_loop and parameters.get("anyio_backend", ASYNCIO) not in (ASYNCIO, "asyncio")


@contextmanager
def skip_without_extra() -> Iterator[None]:
    """Skip what fails for want of an extra, with its name."""
    try:
        yield
    except (Exception, SystemExit) as error:
        extra = absent_extra(error)
        if extra is None:
            raise
        pytest.skip(f"the extra {extra} is not installed", allow_module_level=True)


class TestFile(pytest.Module):
    """A file of tests; one that cannot be imported for want of an extra is skipped as a whole."""

    def collect(self) -> Iterable[pytest.Item | pytest.Collector]:
        with skip_without_extra():
            return super().collect()


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    module: pytest.Module = TestFile.from_parent(parent, path=module_path)
    return module


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, None, None]:
    with skip_without_extra():
        backend = item.callspec.params.get("anyio_backend") if hasattr(item, "callspec") else None
        if isinstance(backend, tuple) and backend[1].get("use_uvloop"):
            # Anyio's plugin does not recover from a runner that it cannot start.
            import_module("uvloop")
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    with skip_without_extra(), end_in_time(item):
        yield


@contextmanager
def end_in_time(item: pytest.Item) -> Iterator[None]:
    """End a test that hangs; one that does not return to Python is ended with its process, by faulthandler."""
    if not hasattr(signal, "setitimer"):
        yield
        return
    slow = item.get_closest_marker("thorough") is not None or "benchmarks" in item.path.parts
    limit = THOROUGH_LIMIT if slow else LIMIT

    def end(*_: object) -> None:
        pytest.fail(f"it has not ended within {limit:g} s")

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None, bool, bool]:
    """Kill the processes that the tests of a file have left, when the last of them has ended."""
    done = yield
    if nextitem is None or nextitem.path != item.path:
        for process in children_left():
            os.kill(process, signal.SIGKILL)
    return done


def children_left() -> list[int]:
    """The processes that this one has started, but for those of pytest and multiprocessing; on Linux only."""
    found = []
    for children in Path("/proc/self/task").glob("*/children"):
        try:
            started = children.read_text().split()
        except OSError:
            # The thread has ended, and another one has its children.
            continue
        for process in started:
            with suppress(OSError):
                # A process that ends, or is just beginning, has none.
                command = Path("/proc", process, "cmdline").read_bytes()
                if command and not any(word in command for word in (b"execnet", b"resource_tracker", b"forkserver")):
                    found.append(int(process))
    return found


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


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture
def bus(clock: SimulatedClock) -> Iterator[Bus]:
    with Bus(clock) as bus:
        yield bus


@pytest.fixture
def buffer(bus: Bus) -> Iterator[Buffer]:
    with Buffer(bus) as buffer:
        yield buffer


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A place for a recording."""
    return tmp_path / "run.mcap"

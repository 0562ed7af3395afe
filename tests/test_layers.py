"""The shape of the package: which module may import which, and what none of them may."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import tfbus

PACKAGE = Path(tfbus.__file__).parent

# A module imports only from the lines before its own.
ABOVE_THE_ASYNC_LINE = [
    ("stamps", "once", "registration", "names", "statistics", "read_only"),
    ("errors", "policy", "events"),
    ("geometry", "drops", "pending_messages"),
    ("stamped", "history", "transform_array", "joint"),
    ("data.header", "data.arrays", "urdf", "tf_message"),
    ("data.dispatch", "robot", "recording.storage"),
    ("data.points", "data.spatial", "data.clouds", "recording.channels"),
    ("data.scans", "recording.folder", "recording.mcap", "recording.payload", "recording.ros1", "recording.sqlite"),
    ("data", "path", "curve", "picture", "announcer", "ownership", "sample_queue", "staleness", "waiting"),
    ("recording.files",),
    ("topology", "subscribers", "event_queue", "recording.backlog"),
    ("forest", "data_question", "placement"),
    ("resolve",),
    ("batch", "explanation", "velocity", "watch_index"),
    ("reader", "prefix"),
    ("tree",),
    ("feed", "recording.loading"),
    ("recording.summary",),
]
BELOW_THE_ASYNC_LINE = [
    ("ticks", "doorbell", "bus_thread", "own_tasks", "reading", "recording.mcap_output"),
    ("threadsafe",),
    ("clock", "stream", "recording.read_ahead"),
    ("event_stream",),
    ("bus", "waiting_room"),
    ("watch", "recording.player", "recording.recorder"),
    ("recording",),
    ("broadcaster", "robot_state", "buffer"),
    ("targets",),
    ("message_filter",),
    ("__init__",),
    ("tutorial", "testing"),
    ("links", "links.arrivals", "links.attachment", "links.peers", "links.zenoh_settings"),
    ("links.received",),
    ("links.relay",),
    ("links.inbox", "links.outbox"),
    ("links.zenoh_statics",),
    ("links.zenoh_session",),
    ("links.zenoh",),
    ("cli.instants", "cli.options", "cli.printable", "cli.progress", "cli.running"),
    ("cli.link",),
    ("cli.tree_display",),
    ("cli.broadcast", "cli.demo", "cli.echo", "cli.listen", "cli.robot", "cli.static", "cli.tree"),
    ("cli.info",),
    ("cli.play", "cli.query", "cli.record"),
    ("cli",),
]
LAYERS = ABOVE_THE_ASYNC_LINE + BELOW_THE_ASYNC_LINE
LAYER_OF = {module: layer for layer, modules in enumerate(LAYERS) for module in modules}

EFFECTS = {"anyio", "asyncio", "sniffio", "socket", "threading", "time", "trio"}
ALLOWED_EFFECTS = {"reader": {"threading"}}

CORE = {"anyio", "numpy", "transforms3d"}
EXTRAS = {
    "cyclopts",
    "hypothesis",
    "mcap",
    "rich",
    "rosbags",
    "starlette",
    "urdf_parser_py",
    "uvicorn",
    "zenoh",
    "zstandard",
}
LINKS_OVER_ZENOH = ("links.zenoh", "links.zenoh_session", "links.zenoh_settings", "links.zenoh_statics")
ALLOWED_EXTRAS = {
    **{module: {"zenoh"} for module in LINKS_OVER_ZENOH},
    "cli": {"cyclopts"},
    "cli.options": {"cyclopts"},
    "cli.echo": {"cyclopts"},
    "cli.link": {"cyclopts"},
    "cli.robot": {"cyclopts"},
    "cli.static": {"cyclopts"},
    "cli.tree": {"cyclopts"},
    "cli.tree_display": {"rich"},
    "cli.demo": {"cyclopts"},
    "cli.info": {"cyclopts", "rich"},
    "cli.instants": {"cyclopts"},
    "cli.progress": {"rich"},
    "cli.play": {"cyclopts", "rich"},
    "cli.query": {"cyclopts"},
    "cli.record": {"cyclopts"},
    "recording.folder": {"zstandard"},
    "recording.mcap": {"mcap", "zstandard"},
    "recording.mcap_output": {"mcap"},
    "recording.payload": {"rosbags", "zstandard"},
    "recording.ros1": {"rosbags"},
    "urdf": {"urdf_parser_py"},
}


def module_name(path: Path) -> str:
    """Of a folder, the name is that of its ``__init__``; that of the package itself is ``__init__``."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


SOURCES = {module_name(path): path for path in PACKAGE.rglob("*.py")}
MODULES = sorted(SOURCES)


def imports(module: str) -> Iterator[str]:
    """The full name of everything that a module imports anywhere, in functions too."""
    for node in ast.walk(ast.parse(SOURCES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"tfbus.{module}, line {node.lineno}: imports are absolute here"
            assert node.module is not None
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def own_imports(module: str) -> set[str]:
    """The modules of tfbus that a module imports; ``__init__`` for a name that the package itself gives."""
    found = set()
    for name in imports(module):
        top, _, rest = name.partition(".")
        if top == "tfbus":
            owners = [known for known in SOURCES if f"{rest}.".startswith(f"{known}.")]
            found.add(max(owners, key=len, default="__init__"))
    return found


def foreign_imports(module: str) -> set[str]:
    return {name.partition(".")[0] for name in imports(module)} - {"tfbus"}


def test_every_module_has_one_layer_and_every_layer_has_its_modules() -> None:
    listed = [module for modules in LAYERS for module in modules]
    assert len(listed) == len(set(listed))
    assert set(listed) == set(SOURCES)


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_only_from_the_layers_before_its_own(module: str) -> None:
    assert {name for name in own_imports(module) if LAYER_OF[name] >= LAYER_OF[module]} == set()


@pytest.mark.parametrize("module", sorted(module for modules in ABOVE_THE_ASYNC_LINE for module in modules))
def test_nothing_above_the_async_line_imports_a_loop_a_thread_a_socket_or_a_clock(module: str) -> None:
    assert foreign_imports(module) & EFFECTS <= ALLOWED_EFFECTS.get(module, set())


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_nothing_beyond_the_dependencies_but_the_extras_it_is_there_for(module: str) -> None:
    foreign = foreign_imports(module) - set(sys.stdlib_module_names) - CORE
    assert foreign - ALLOWED_EXTRAS.get(module, set()) == set()


@pytest.mark.parametrize("module", MODULES)
def test_no_import_hides_behind_type_checking(module: str) -> None:
    assert "TYPE_CHECKING" not in SOURCES[module].read_text(encoding="utf-8")


@pytest.mark.parametrize("module", MODULES)
def test_no_module_is_longer_than_400_lines(module: str) -> None:
    assert len(SOURCES[module].read_text(encoding="utf-8").splitlines()) <= 400


def test_importing_the_package_imports_no_extra() -> None:
    script = "import sys, tfbus; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert {"tfbus", *CORE} <= set(loaded)
    assert set(loaded) & EXTRAS == set()

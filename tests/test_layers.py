"""The floor plan of the package: the rooms, what each may import, and what no module may do."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import tfbus

PACKAGE = Path(tfbus.__file__).parent

GROUND = ("stamps", "plain", "errors", "events", "frames", "registration", "statistics", "clock", "_log", "_aio")

# Each room with the rooms that it may import. It may import from the ground, and from the rooms that those may import.
ROOMS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(GROUND, ()),
    "geometry": (),
    "data": ("geometry",),
    "tf_message": ("geometry",),
    "tree": ("data",),
    "waiting": ("tree",),
    "bus": ("waiting",),
    "buffer": ("bus",),
    "message_filter": ("buffer",),
    "robot": ("bus",),
    "links": ("bus", "tf_message"),
    "analysis": ("tree",),
    "recording": ("analysis", "robot", "tf_message"),
    "view": ("buffer", "recording", "robot"),
    "plot": ("recording",),
    "testing": ("geometry",),
    "__init__": ("analysis", "message_filter", "robot"),
    "cli": ("__init__", "links", "plot", "view"),
    "__main__": ("cli",),
}

SANS_IO = {*GROUND, "analysis", "geometry", "data", "tf_message", "tree", "waiting"} - {"clock", "_aio"}
EFFECTS = {"anyio", "asyncio", "sniffio", "socket", "threading", "time", "trio"}
ALLOWED_EFFECTS = {"tree.forest": {"threading"}}

CORE = {"anyio", "numpy", "transforms3d"}
# The module, or the room, that each extra is for.
EXTRAS = {
    "cyclonedds": ("links.dds",),
    "cyclopts": ("cli",),
    "foxglove": ("links.foxglove",),
    "lz4": ("recording.formats",),
    "matplotlib": ("plot",),
    "mcap": ("recording.formats",),
    "mcap_protobuf": ("recording.formats",),
    "pyarrow": ("cli",),
    "rich": ("cli", "view"),
    "rosbags": ("recording.formats",),
    "ruamel": ("recording.formats",),
    "scipy": ("geometry",),
    "trimesh": ("view",),
    "urdf_parser_py": ("robot",),
    "viser": ("view",),
    "zenoh": ("links.zenoh",),
    "zstandard": ("recording.formats",),
}
NEVER_LOADED = {*EXTRAS, "hypothesis", "starlette", "uvicorn"}


def module_name(path: Path) -> str:
    """The name of a module inside the package. A door has the name of its room, that of the package is ``__init__``."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


SOURCES = {module_name(path): path for path in PACKAGE.rglob("*.py")}
MODULES = sorted(SOURCES)
DOORS = {module for module in MODULES if SOURCES[module].name == "__init__.py"}


def room_of(module: str) -> str:
    return module.partition(".")[0]


def allowed_rooms(room: str) -> set[str]:
    """The rooms that a room may import, itself included."""
    allowed = {room, *GROUND}
    ahead = [room]
    while ahead:
        new = set(ROOMS[ahead.pop()]) - allowed
        allowed |= new
        ahead += new
    return allowed


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
    """The modules of tfbus that a module imports."""
    found = set()
    for name in imports(module):
        top, _, rest = name.partition(".")
        if top == "tfbus":
            owners = [known for known in SOURCES if f"{rest}.".startswith(f"{known}.")]
            found.add(max(owners, key=len, default="__init__"))
    return found


def foreign_imports(module: str) -> set[str]:
    return {name.partition(".")[0] for name in imports(module)} - {"tfbus"}


OWN_IMPORTS = {module: own_imports(module) for module in MODULES}


def code_lines(path: Path) -> int:
    """The number of lines without docstrings, comments and blank lines."""
    text = path.read_text(encoding="utf-8")
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and node.body:
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                docstrings.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    lines = enumerate(text.splitlines(), 1)
    return sum(1 for number, line in lines if number not in docstrings and line.strip() and line.strip()[0] != "#")


def test_every_module_is_in_a_room_of_the_plan_and_the_plan_has_at_most_26_rooms() -> None:
    assert {room_of(module) for module in MODULES} == set(ROOMS)
    assert len(ROOMS.keys() - {"__init__", "__main__"}) <= 26


def test_no_room_may_import_itself_through_another() -> None:
    tuple(TopologicalSorter(ROOMS).static_order())


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_only_from_the_rooms_that_its_room_may_import(module: str) -> None:
    allowed = allowed_rooms(room_of(module))
    assert {name for name in OWN_IMPORTS[module] if room_of(name) not in allowed} == set()


def test_no_module_imports_itself_through_another() -> None:
    tuple(TopologicalSorter(OWN_IMPORTS).static_order())


@pytest.mark.parametrize("module", [module for module in MODULES if room_of(module) in SANS_IO])
def test_nothing_above_the_async_line_imports_a_loop_a_thread_a_socket_or_a_clock(module: str) -> None:
    assert foreign_imports(module) & EFFECTS <= ALLOWED_EFFECTS.get(module, set())


@pytest.mark.parametrize("module", [module for module in MODULES if module not in DOORS and room_of(module) != "cli"])
def test_a_module_that_only_its_own_room_uses_starts_with_an_underscore_and_no_other(module: str) -> None:
    if module in ROOMS:
        return
    importers = {other for other in MODULES if module in OWN_IMPORTS[other]}
    used_outside = any(room_of(other) != room_of(module) or other in DOORS for other in importers)
    assert module.rpartition(".")[2].startswith("_") is not used_outside


@pytest.mark.parametrize("module", MODULES)
def test_a_module_imports_nothing_beyond_the_dependencies_but_the_extras_of_its_room(module: str) -> None:
    for name in foreign_imports(module) - set(sys.stdlib_module_names) - CORE:
        assert any(f"{module}.".startswith(f"{place}.") for place in EXTRAS[name]), name


@pytest.mark.parametrize("module", MODULES)
def test_no_import_hides_behind_type_checking(module: str) -> None:
    assert "TYPE_CHECKING" not in SOURCES[module].read_text(encoding="utf-8")


@pytest.mark.parametrize("module", MODULES)
def test_no_module_has_more_than_300_lines_of_code(module: str) -> None:
    assert code_lines(SOURCES[module]) <= 300


@pytest.mark.parametrize("room", sorted(DOORS))
def test_every_door_says_what_its_room_is_for(room: str) -> None:
    assert ast.get_docstring(ast.parse(SOURCES[room].read_text(encoding="utf-8")))


def test_every_module_has_a_test_of_its_name() -> None:
    tests = Path(__file__).parent
    missing = []
    for module in MODULES:
        folder, _, name = module.rpartition(".")
        if module not in DOORS and not (tests / folder.replace(".", "/") / f"test_{name}.py").exists():
            missing.append(module)
    assert missing == []


def test_importing_the_package_imports_no_extra() -> None:
    script = "import sys, tfbus; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert {"tfbus", *CORE} <= set(loaded)
    assert set(loaded) & NEVER_LOADED == set()

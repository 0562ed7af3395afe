"""The floor plan of the package: the rooms, what each may import, and what no module may do."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import tfbus

PACKAGE = Path(tfbus.__file__).parent

GROUND = (
    "stamps",
    "plain",
    "errors",
    "events",
    "frames",
    "registration",
    "tf2_names",
    "statistics",
    "rows",
    "_python_kernel",
    "running_kernel",
    "which_kernel",
    "clock",
    "_aio",
)

# Each room with the rooms that it may import. It may import from the ground, and from the rooms that those may import.
ROOMS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(GROUND, ()),
    "geometry": (),
    "axes": ("geometry",),
    "data": ("geometry",),
    "earth": ("data",),
    "tf_message": ("geometry",),
    "uncertainty": ("data",),
    "tree": ("uncertainty",),
    "waiting": ("tree",),
    "bus": ("waiting",),
    "buffer": ("bus",),
    "message_filter": ("buffer",),
    "robot": ("bus", "tf_message"),
    "links": ("buffer", "robot", "tf_message"),
    "camera": ("buffer",),
    "synchronizer": ("buffer",),
    "analysis": ("tree",),
    "recording": ("analysis", "robot", "tf_message"),
    "view": ("links", "recording"),
    "plot": ("recording",),
    "testing": ("geometry",),
    "web": (),
    "__init__": (
        "axes",
        "camera",
        "earth",
        "links",
        "message_filter",
        "plot",
        "recording",
        "synchronizer",
        "testing",
        "view",
        "web",
    ),
    "cli": ("__init__",),
    "__main__": ("cli",),
}

_PLAIN_ROOMS = {"analysis", "axes", "data", "earth", "geometry", "tf_message", "tree", "uncertainty", "waiting"}
SANS_IO = {*GROUND, *_PLAIN_ROOMS} - {"clock", "_aio"}
EFFECTS = {"anyio", "asyncio", "sniffio", "socket", "threading", "time", "trio"}
# The judge of a bus notices by itself that its comparison with the clock has grown old.
ALLOWED_EFFECTS = {"tree.forest": {"threading"}, "_python_kernel": {"time"}}

CORE = {"anyio", "numpy", "transforms3d"}
# The module, or the room, that each extra is for.
EXTRAS = {
    "cbor2": ("links.rosbridge",),
    "cyclonedds": ("links.dds",),
    "cyclopts": ("cli",),
    "foxglove": ("links.foxglove", "recording.formats"),
    "lz4": ("recording.formats",),
    "matplotlib": ("plot",),
    "mcap": ("recording.formats",),
    "mcap_protobuf": ("recording.formats",),
    "pyarrow": ("cli",),
    "pydantic_core": ("plain",),
    "rich": ("cli",),
    "rosbags": ("recording.formats",),
    "ruamel": ("recording.formats", "recording.static_frames"),
    "scipy": ("geometry",),
    "trimesh": ("view",),
    "urdf_parser_py": ("robot",),
    "wsproto": ("_aio.websocket", "links.rosbridge"),
    "zenoh": ("links.rmw_zenoh", "links.zenoh"),
    "zstandard": ("recording.formats",),
}
NEVER_LOADED = {*EXTRAS, "fastapi", "hypothesis", "starlette", "uvicorn"}


def module_name(path: Path) -> str:
    """The name of a module inside the package. A door has the name of its room, that of the package is ``__init__``."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


# The build hook is no module of the package: nothing imports it, and no wheel has it.
SOURCES = {module_name(path): path for path in PACKAGE.rglob("*.py") if path.name != "_build.py"}
# The door of the package loads what it exports when it is used; its imports are those of the stub beside it.
SOURCES["__init__"] = PACKAGE / "__init__.pyi"
MODULES = sorted(SOURCES)
DOORS = {module for module in MODULES if SOURCES[module].stem == "__init__"}


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


def parsed(module: str) -> ast.Module:
    """The tree of a module, which nobody keeps: a million nodes would be in the way of the garbage collector."""
    return ast.parse(SOURCES[module].read_text(encoding="utf-8"))


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """All statements below a node; `ast.walk` would go through their expressions too."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.stmt, ast.excepthandler, ast.match_case)):
            yield child
            yield from statements(child)


@cache
def imports(module: str) -> frozenset[str]:
    """The full name of everything that a module imports anywhere, in functions too."""
    found: set[str] = set()
    for node in statements(parsed(module)):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"tfbus.{module}, line {node.lineno}: imports are absolute here"
            assert node.module is not None
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(found)


@cache
def own_imports(module: str) -> frozenset[str]:
    """The modules of tfbus that a module imports."""
    found: set[str] = set()
    for name in imports(module):
        top, _, rest = name.partition(".")
        # The compiled kernel belongs to the ground, and imports nothing of tfbus.
        if top == "tfbus" and rest.partition(".")[0] != "_kernel":
            while rest and rest not in SOURCES:
                rest = rest.rpartition(".")[0]
            found.add(rest or "__init__")
    return frozenset(found)


def foreign_imports(module: str) -> set[str]:
    return {name.partition(".")[0] for name in imports(module)} - {"tfbus"}


def test_every_module_is_in_a_room_of_the_plan() -> None:
    assert {room_of(module) for module in MODULES} == set(ROOMS)


def test_no_room_may_import_itself_through_another() -> None:
    tuple(TopologicalSorter(ROOMS).static_order())


def test_a_module_imports_only_from_the_rooms_that_its_room_may_import() -> None:
    wrong = []
    for module in MODULES:
        allowed = allowed_rooms(room_of(module))
        wrong += [(module, name) for name in own_imports(module) if room_of(name) not in allowed]
    assert wrong == []


def test_no_module_imports_itself_through_another() -> None:
    tuple(TopologicalSorter({module: own_imports(module) for module in MODULES}).static_order())


def test_nothing_above_the_async_line_imports_a_loop_a_thread_a_socket_or_a_clock() -> None:
    above = [module for module in MODULES if room_of(module) in SANS_IO]
    found = {module: foreign_imports(module) & EFFECTS for module in above}
    assert {module: names for module, names in found.items() if names} == ALLOWED_EFFECTS


def test_a_module_imports_nothing_beyond_the_dependencies_but_the_extras_of_its_room() -> None:
    wrong = [
        (module, name)
        for module in MODULES
        for name in foreign_imports(module) - sys.stdlib_module_names - CORE
        if not any(f"{module}.".startswith(f"{place}.") for place in EXTRAS.get(name, ()))
    ]
    assert wrong == []


def test_no_import_hides_behind_type_checking() -> None:
    assert [module for module in MODULES if "TYPE_CHECKING" in SOURCES[module].read_text(encoding="utf-8")] == []


def test_no_room_imports_what_another_marks_as_its_own() -> None:
    # An underscore marks what no other room may import. The kernels and the event loops belong to all.
    wrong = [
        (module, name)
        for module in MODULES
        for name in imports(module)
        if name.startswith("tfbus.")
        and any(part.startswith("_") and not part.startswith("__") for part in name.split(".")[2:])
        and room_of(name.removeprefix("tfbus.")) not in {room_of(module), "_aio"}
    ]
    assert wrong == []


def test_every_door_says_what_its_room_is_for() -> None:
    assert [room for room in sorted(DOORS) if not ast.get_docstring(parsed(room))] == []


def loaded_by(statement: str) -> set[str]:
    """The packages that a statement loads in a new process."""
    script = f"import sys; {statement}; print(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_the_package_imports_none_other() -> None:
    loaded = loaded_by("import tfbus")
    assert "tfbus" in loaded
    assert loaded & (CORE | NEVER_LOADED | {"asyncio"}) == set()


def test_importing_all_public_names_imports_no_extra() -> None:
    loaded = loaded_by("from tfbus import *")
    # A conversion imports transforms3d, and with it numpy's random numbers.
    assert loaded & CORE == CORE - {"transforms3d"}
    assert loaded & NEVER_LOADED == set()

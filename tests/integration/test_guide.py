"""The guide and the README tell the truth: their programs run, their commands parse, and their links lead somewhere.

A block of ``python`` runs by itself and prints something. A block of ``text`` right below it is what it prints. A block
of ``py`` is an excerpt from a demo.
"""

import importlib
import re
import shlex
import tomllib
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import pytest
from support.commands import Command
from support.processes import Program, start_tfbus
from support.recorded import Line, write_mcap

import tfbus
from tfbus.cli.application import application

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "demos" / "guide"
README = (ROOT / "README.md").read_text()
CALIBRATION = (GUIDE / "calibration.md").read_text()
TF2 = (GUIDE / "tf2.md").read_text()
PAGES = [ROOT / "README.md", *sorted(GUIDE.glob("*.md"))]
REFERENCE = sorted((GUIDE / "reference").glob("*.rst"))
PUBLIC = [
    "tfbus",
    "tfbus.data",
    "tfbus.links",
    "tfbus.links.dds",
    "tfbus.links.foxglove",
    "tfbus.links.rmw_zenoh",
    "tfbus.links.ros",
    "tfbus.links.rosbridge",
    "tfbus.links.zenoh",
    "tfbus.plot",
    "tfbus.recording",
    "tfbus.robot",
    "tfbus.testing",
    "tfbus.view",
    "tfbus.web",
]
CONSOLE = re.compile(r"^```console\n([\s\S]*?)^```|((?:^    \S.*\n)+)", re.MULTILINE)


class Block(NamedTuple):
    """A program of a page, and what the page says that it prints."""

    program: str
    output: str


def blocks_of(page: Path) -> list[Block]:
    fences = re.findall(r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```)?", page.read_text(), re.DOTALL | re.MULTILINE)
    return [Block(program, output) for program, output in fences]


def prose_of(page: Path) -> str:
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def anchors_of(page: Path) -> set[str]:
    """The anchors that GitHub and the site give to the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", prose_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def commands_of(page: Path) -> list[str]:
    """The command lines of a page, without comments; commands that ``&&`` joins count one by one."""
    lines = [line for match in CONSOLE.finditer(page.read_text()) for line in (match[1] or match[2]).splitlines()]
    commands = [part.strip() for line in lines for part in line.partition(" # ")[0].split("&&")]
    return [command for command in commands if re.match(r"(tfbus|pip install) ", command)]


PROGRAMS = [
    pytest.param(page, block, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, block in enumerate(blocks_of(page))
]
TYPED = [(page, command) for page in PAGES for command in commands_of(page)]
COMMANDS = [pytest.param(command, id=f"{page.stem}-{command}") for page, command in TYPED]
OUTSIDE = re.compile(r"--(ros|connect|listen|svg) |^pip|dds|^tfbus (router|view|foxglove|rosbridge)")
"""A command that needs another machine, ROS, a browser, Graphviz, or a port that may be taken."""
OWN = {command: page.stem for page, command in TYPED if not OUTSIDE.search(command)}
OF_FILES = re.compile(r"tfbus (info|query|convert|compare|plot|check \S+\.|robot .*--tree)")


@pytest.mark.parametrize(("page", "block"), PROGRAMS)
def test_every_program_prints_what_the_page_says(page: Path, block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(block.program, page.name, "exec"), {"__name__": "__main__"})
    output = capsys.readouterr().out
    assert output
    if block.output:
        assert output == block.output


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_excerpt_is_from_a_demo(page: Path) -> None:
    demos = [without_indent(path.read_text()) for path in (ROOT / "demos").glob("*.py")]
    for excerpt in re.findall(r"^```py\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
        assert any(without_indent(excerpt) in demo for demo in demos), excerpt


def without_indent(text: str) -> str:
    return re.sub(r"^ +", "", text, flags=re.MULTILINE)


def test_troubleshooting_names_every_error() -> None:
    page = (GUIDE / "troubleshooting.md").read_text()
    errors = {name for name in tfbus.__all__ if name.endswith("Error")}
    groups = {"TransformError", "TransformLookupError", "ExtrapolationError"}
    assert {name for name in errors - groups if f"`{name}`" not in page} == set()


def test_every_page_that_teaches_has_a_program_and_names_a_demo() -> None:
    for page in PAGES:
        if page.stem in (
            "index",
            "README",
            "protocol",
            "limits",
            "security",
            "changelog",
            "contributing",
            "commands",
            "demos",
        ):
            continue
        assert blocks_of(page), page.name
        assert re.search(r"^## Run it\n\n(?:.*\n)*.*\]\(\.\./\w+\.py\)", page.read_text(), re.MULTILINE), page.name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_link_leads_to_a_file_and_to_a_heading_in_it(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", prose_of(page)):
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), link
        assert not anchor or anchor in anchors_of(file), link


def test_every_demo_and_every_page_is_named_by_the_readme_or_the_guide() -> None:
    linked = {
        (page.parent / link.partition("#")[0]).resolve()
        for page in PAGES
        for link in re.findall(r"\]\(([^)\s]+)\)", prose_of(page))
    }
    missing = {path for path in (ROOT / "demos").iterdir() if path.is_file()} - linked
    assert not missing
    listed = re.findall(r"^([\w/]+)$", (GUIDE / "index.md").read_text(), re.MULTILINE)
    assert {f"{name}.md" for name in listed if "/" not in name} == {page.name for page in PAGES[1:]} - {"index.md"}


def test_the_urls_of_the_package_lead_to_pages_that_are_here() -> None:
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]
    for name, url in urls.items():
        assert url.startswith(urls["Source"])
        path = url.partition("/blob/main/")[2]
        assert not path or (ROOT / path).is_file(), name


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_can_be_typed(command: str) -> None:
    words = shlex.split(command)
    if words[0] == "tfbus":
        application(None).meta.parse_args(words[1:], exit_on_error=False, print_error=False)
        return
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    wanted = re.findall(r"\[(.*)\]", command)
    assert set(",".join(wanted).split(",")) - {""} <= extras.keys()


def write_recording(path: Path) -> None:
    """A recording that fits all commands of the guide, under any name: the format is recognised by the content."""
    start = tfbus.from_seconds(1_396_293_860)  # 2014-03-31T19:24:20
    identity = tfbus.Transform()
    statics = [
        tfbus.TransformStamped("base_link", child, start, identity, static=True)
        for child in ("laser", "lidar", "camera", "base_laser")
    ]
    lines: list[Line] = [(start, "/tf_static", statics)]
    for stamp in range(start, start + 90 * tfbus.SECOND, tfbus.SECOND // 2):
        moved = tfbus.Transform((1e-9 * (stamp - start), 0.0, 0.0))
        pair = [tfbus.TransformStamped("map", "odom", stamp, identity)]
        pair.append(tfbus.TransformStamped("odom", "base_link", stamp, moved))
        lines += [(stamp, "/tf", pair), (stamp, "/robot1/tf", pair[1:]), (stamp, "/image", bytes(8))]
    write_mcap(path, lines)


@pytest.mark.parametrize("command", [pytest.param(command, id=command) for command in OWN if OF_FILES.match(command)])
def test_a_command_of_files_does_what_it_says(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for option, package in (("--parquet", "pyarrow"), ("plot", "matplotlib")):
        if option in command:
            pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demos").symlink_to(ROOT / "demos")
    words = shlex.split(command)[1:]
    files = [word for word in words if word.endswith((".mcap", ".bag", ".tum"))]
    outputs = {word for before, word in pairwise(words) if before in ("-o", "--parquet", "--plot", "--static-to-yaml")}
    outputs |= set(files[1:]) if words[0] == "convert" else set()
    for file in set(files) - outputs:
        write_recording(tmp_path / file)
    done = Command(monkeypatch, capsys)(*words)
    assert done.returncode == 0, done.stderr
    assert done.stdout or outputs
    assert all((tmp_path / output).stat().st_size for output in outputs)


@pytest.mark.thorough
def test_the_commands_of_a_domain_run_beside_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demos").symlink_to(ROOT / "demos")
    write_recording(tmp_path / "run.mcap")
    (tmp_path / "calibration.yaml").write_text(re.findall(r"```yaml\n(.*?)```", CALIBRATION, re.DOTALL)[0])
    commands = [command for command in OWN if not OF_FILES.match(command)]
    assert len(commands) > 8
    with ExitStack() as stack:
        # The path of a socket is short.
        monkeypatch.setenv("TFBUS_RUNTIME_DIR", stack.enter_context(TemporaryDirectory()))
        programs: list[tuple[str, Program]] = []
        for command in commands:
            command = command.replace("record run.mcap", f"record {len(programs)}.mcap")
            programs.append((command, stack.enter_context(start_tfbus(*shlex.split(command)[1:]))))
        for command, program in programs:
            ends = re.match("tfbus tree", command)
            said = program.errors if re.search("static|broadcast|record|play|robot|check", command) else program.output
            assert said.expect(".").strip(), command
            assert (program.wait() if ends else program.end()) == (0 if ends else 130), (command, program.errors.text)


def test_every_public_name_is_on_one_page_of_the_reference() -> None:
    directives = r"^\.\. (?:auto(?:class|exception|function|data):: ([\w.]+)\.|data:: )(\w+)"
    listed = [found for page in REFERENCE for found in re.findall(directives, page.read_text(), re.MULTILINE)]
    documented = [id(getattr(importlib.import_module(path or "tfbus"), name)) for path, name in listed]
    assert len(documented) == len(set(documented))
    for path in PUBLIC:
        module = importlib.import_module(path)
        own = [
            name
            for name, thing in vars(module).items()
            if not name.startswith("_") and getattr(thing, "__module__", None) == path and callable(thing)
        ]
        for name in getattr(module, "__all__", own):
            assert id(getattr(module, name)) in documented, f"{path}.{name} is on no page of the reference"


# The README


def test_the_examples_of_the_readme_print_what_their_comments_say(capsys: pytest.CaptureFixture[str]) -> None:
    for block in blocks_of(ROOT / "README.md")[:2]:
        exec(compile(block.program, "README.md", "exec"), {"__name__": "__main__"})
    output = capsys.readouterr().out
    for said in ("(1.1, 0.2, 0.2)", "translation=(1.5, 0.0, 0.0)", "did you mean 'base_link'?"):
        assert said in output


def test_the_examples_and_the_whole_are_as_short_as_promised() -> None:
    assert len(blocks_of(ROOT / "README.md")[0].program.strip().splitlines()) <= 12
    assert len(README.splitlines()) <= 150


def test_every_name_that_the_table_for_tf2_users_mentions_exists() -> None:
    table = TF2.partition("## Names")[2].partition("## ")[0]
    ours = "".join(line.split("|")[2] for line in table.splitlines() if line.count("|") == 3)
    owners = {"buffer": tfbus.Buffer, "tree": tfbus.TransformTree, "broadcaster": tfbus.TransformBroadcaster}
    methods = re.findall(r"\b(buffer|tree|broadcaster)\.(\w+)", ours)
    assert methods
    for owner, method in methods:
        assert hasattr(owners[owner], method), f"{owner}.{method}"
    for name in re.findall(r"\b([A-Z]\w+)\(|`(\w+Error)`", ours):
        assert hasattr(tfbus, name[0] or name[1])


def test_the_picture_is_what_describe_shows() -> None:
    clock = tfbus.SimulatedClock()
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        calibration = tfbus.TransformBroadcaster(bus, authority="calibration")
        calibration.send_static("base_link", "base_laser", tfbus.Transform((0.1, 0.0, 0.2)))
        calibration.send_static("base_link", "camera", tfbus.Transform((0.3, 0.0, 0.5)))
        slam = tfbus.TransformBroadcaster(bus, authority="slam")
        odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
        for tick in range(1001):
            odometry.send("odom", "base_link", tfbus.Transform(), at=tick * 10_000_000)
        for tick in range(100):
            slam.send("map", "odom", tfbus.Transform(), at=tick * 100_000_000 + 63_000_000)
        clock.set(tfbus.from_seconds(10.004))
        picture = buffer.describe()
    assert f"```\n{picture}\n```" in README


@pytest.mark.parametrize("command", ['pip install ".[cli]" && tfbus demo', 'pip install ".[test]" && pytest'])
def test_both_commands_are_what_ci_types(command: str) -> None:
    assert f"    {command}\n" in README
    assert command in (ROOT / ".ci" / "run").read_text()

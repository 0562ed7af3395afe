"""No name from elsewhere begins a line, commands a terminal or hides in a text for people.

Every door that makes such texts is walked with all names. The texts of the same things with plain names say how many
lines there should be. New errors, events and commands are found by themselves.
"""

import csv
import html.parser
import io
import json
import logging
import os
import types
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from operator import methodcaller
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import anyio
import anyio.lowlevel
import pytest
from support.commands import Command, Done, nobody
from support.recorded import write_mcap
from support.samples import moving, static, tree_of

from tfbus import (
    SECOND,
    Bus,
    Edge,
    Event,
    ExtrapolationError,
    InvalidTransformError,
    PointStamped,
    SimulatedClock,
    SystemClock,
    TransformError,
    TransformStamped,
    TransformTree,
    UnknownFrameError,
    errors,
)
from tfbus.analysis import Finding
from tfbus.buffer.buffer import Buffer
from tfbus.cli.application import COMMANDS
from tfbus.recording import Recorder, load, load_static, save_static
from tfbus.robot import Joint, RobotModel
from tfbus.stamps import LATEST, Latest
from tfbus.testing import simulate
from tfbus.tf_message import MalformedMessageError

# Of each kind of letter that is not printable, some: controls of both kinds, separators, marks of the direction of a
# text, blanks that take no place or look like others, tags, private letters, and numbers that are no letter.
HIDDEN = (
    "\a\b\0\t\v\f\x1c\x1d\x1e\x7f\x85\x9b\x9d\xa0\xad\u061c\u180e\u2003\u200b\u200d\u200e\u200f\u2028\u2029\u202d\u202e"
)
HIDDEN += "\u2066\u3000\ue000\ufdd0\ufeff\uffff\U000e0041\U0010fffd"
BREAK, CLEAR, FORMULA = "x\n2026-11-25 00:00:00 CRITICAL emergency stop released", "\x1b[2J\x1b[H", "$\\frac{1}{$"
NAMES = [
    *(BREAK, CLEAR, FORMULA, BREAK.replace("\n", "\r"), "x\r\ntfbus: nothing is wrong", "x\n\n\n└── base_link  static"),
    *("\x1b]0;title\x07", "\x1b]8;;http://evil.example\x1b\\link\x1b]8;;\x1b\\", "\x9b2J", "\x9d0;title\x9c"),
    *(f"x{letter}moc.live" for letter in HIDDEN),
    *("[bold red]x[/bold red]", "[link=http://evil.example]x[/]", "$x^2$", "_hidden", "<script>alert(1)</script>"),
    *("&#8238;&#10;<br>", "{0.__class__} %s %d %(name)s", '"quoted\\" \\n', "größe 基座 🦾", "l" * 1_000),
]
PLAIN = [f"frame{number}" for number in range(len(NAMES))]
HALF = "half\ud800"
"""No file and no message can hold it, but a frame can be called so."""


def lines_of(text: str) -> list[str]:
    """The lines of a text, none of which has a character that is more than a letter."""
    lines = text.split("\n")
    assert [line for line in lines if not line.isprintable()] == []
    return lines


def check_each(make: Callable[[str], str]) -> None:
    """Check the texts that are made with one name each."""
    count = len(lines_of(make("plain")))
    assert [name for name in (*NAMES, HALF) if len(lines_of(make(name))) != count] == []


def value_of(hint: Any, name: str) -> Any:
    """A value of a type, with the name in it wherever there is a text."""
    if get_origin(hint) is types.UnionType:
        kinds = [kind for kind in get_args(hint) if kind is not types.NoneType]
        return value_of(str if str in kinds else kinds[-1] if Exception in kinds else kinds[0], name)
    if get_origin(hint) is tuple:
        return tuple(value_of(kind, name) for kind in get_args(hint) if kind is not Ellipsis)
    if hint is Exception:
        return ValueError(name)
    values = {str: name, int: 5, float: 1.5, bool: False, Latest: LATEST}
    assert hint in values, f"say what a value of {hint} is with a name in it"
    return values[hint]


# Texts of the library

ERRORS = [
    kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, TransformError) and kind.__module__ == errors.__name__
]


@pytest.mark.parametrize("kind", ERRORS)
def test_every_error_is_one_line(kind: type[TransformError]) -> None:
    def make(name: str) -> str:
        facts = {fact: value_of(hint, name) for fact, hint in get_type_hints(kind).items() if fact[0] != "_"}
        if kind is UnknownFrameError:
            facts["close_matches"] = [name]
        if issubclass(kind, ExtrapolationError):
            facts["clock"] = name
        cause = UnknownFrameError(frame=name, known=(name + "x",)).to_dict()
        data = {"type": kind.__name__, "message": name, **facts, "cause": cause}
        error = kind.from_dict(json.loads(json.dumps(data, default=lambda value: value.value)))
        assert all(getattr(error, fact) == value for fact, value in facts.items() if isinstance(value, str))
        return f"{error}\n{error!r}\n{error.__cause__}"

    check_each(make)


def test_errors_that_are_made_of_a_text_are_one_line() -> None:
    def make(name: str) -> str:
        made = (
            errors.RecordingError(name, path=name, reason="damaged"),
            errors.MissingRecordingError(path=name),
            errors.InvalidRobotError(name, element=f"<joint name={name!r}>"),
            InvalidTransformError(name, reason="frame name"),
            errors.BusClosedError(name),
            MalformedMessageError("text", name),
        )
        return "\n".join(map(str, made))

    check_each(make)


@pytest.mark.parametrize("kind", get_args(Event))
def test_every_event_is_one_line(kind: Any) -> None:
    hints = get_type_hints(kind)
    check_each(lambda name: str(kind(**{field.name: value_of(hints[field.name], name) for field in fields(kind)})))


html_of: Callable[[TransformTree], str] = methodcaller("_repr_html_")
"""As Jupyter asks for it."""


def tree_with(names: Sequence[str]) -> TransformTree:
    """A tree with each name as a frame and as an authority: moving below the map, and static below another name."""
    tops = [moving("map", name, stamp, stamp / SECOND, name) for stamp in (0, SECOND) for name in names]
    return tree_of(*tops, *(static(name, f"{name}'", authority=name) for name in names), moving("moon", "rover", 0))


@pytest.mark.parametrize(
    "make",
    [
        TransformTree.describe,
        TransformTree.to_dot,
        TransformTree.to_yaml,
        lambda tree: tree.to_dot(now=SECOND),
        html_of,
        repr,
    ],
)
def test_every_drawing_of_a_tree_has_a_line_for_each_frame(make: Callable[[TransformTree], str]) -> None:
    labels = sum(not name.isprintable() or "&" in name for name in (*NAMES, *(f"{name}'" for name in NAMES)))
    text, plain = (make(tree_with(names)) for names in (NAMES, PLAIN))
    # Graphviz is told how to show a name that it would not show as it is.
    more = labels if text.startswith("digraph") else 0
    assert len(lines_of(text)) == len(lines_of(plain)) + more
    lines_of(make(tree_with([HALF])))


def test_yaml_and_plain_data_have_every_name_as_it_is() -> None:
    yaml: Any = pytest.importorskip("yaml")
    tree = tree_with(NAMES)
    read = yaml.safe_load(tree.to_yaml())
    assert {child: facts["parent"] for child, facts in read.items()} == {e.child: e.parent for e in tree.edges()}
    for name in (*NAMES, HALF):
        sample = moving("map", name, 0, authority=name)
        assert TransformStamped.from_dict(json.loads(json.dumps(sample.to_dict()))) == sample


def test_a_file_of_static_transforms_has_every_name_as_it_is(tmp_path: Path) -> None:
    yaml: Any = pytest.importorskip("yaml")
    path = tmp_path / "static.yaml"
    samples = [static("map", name, authority=name) for name in (*NAMES, HALF)]
    save_static(path, samples)
    assert [sample.child for sample in load_static(path)] == [*NAMES, HALF]
    assert [entry["child"] for entry in yaml.safe_load(path.read_text())] == [*NAMES, HALF]


def test_every_explanation_has_a_line_for_each_edge() -> None:
    def make(name: str) -> str:
        tree = tree_with([name])
        asked = [("map", f"{name}'"), (f"{name}'", "map"), ("moon", f"{name}'"), (f"{name}!", name)]
        found = [tree.explain(target, source, at) for target, source in asked for at in (LATEST, 0, 9 * SECOND)]
        return "\n".join(map(str, found))

    check_each(make)


def test_values_are_one_line() -> None:
    def make(name: str) -> str:
        sample = moving("map", name, 0, authority=name)
        joint = Joint(name, "revolute", "base", "arm", axis=(0, 0, 1), lower=-1.0, upper=1.0)
        model = RobotModel(name, ["base", "arm"], [joint])
        values = [
            *(sample, static(name, "map"), tree_of(sample).lookup("map", name), PointStamped(name, 0, (1, 2, 3))),
            *(Edge("map", name, False, 1, 0, 0, name), Finding("gap", name, 1, 0, 1.0, "s", name)),
            *(joint, model, *model.violations({name: 9.0})),
        ]
        return "\n".join(text(value) for value in values for text in (str, repr))

    check_each(make)


def test_a_buffer_tells_who_waits_in_one_line_each() -> None:
    async def describe(name: str) -> str:
        with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
            bus.publish(moving("map", name, 0, authority=name))
            async with anyio.create_task_group() as tasks:
                for target, source in (("map", f"{name}?"), (name, f"{name}!")):
                    tasks.start_soon(buffer.lookup, target, source)
                for _ in range(5):
                    await anyio.lowlevel.checkpoint()
                text = "\n".join([buffer.describe(), *map(str, buffer.pending()), repr(buffer), repr(bus)])
                tasks.cancel_scope.cancel()
        return text

    check_each(lambda name: anyio.run(describe, name))


# Log lines


def check_logged(caplog: pytest.LogCaptureFixture, least: int) -> None:
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) >= least
    assert [message for message in messages if not message.isprintable()] == []
    caplog.clear()


def test_no_name_forges_a_line_of_the_log_of_a_bus(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "tfbus")
    for name in (*NAMES, HALF):

        def fails(_: object, name: str = name) -> None:
            # The traceback is Python's, and no report of a test can hold half a character.
            raise ValueError("half" if name == HALF else name)

        fails.__qualname__ = name
        with Bus(SimulatedClock(10 * SECOND)) as bus, Buffer(bus, keep=None):
            bus.publish([moving(name, "arm", SECOND, authority=name), moving("arm", "hand", SECOND, authority=name)])
            # A loop of parents, a loop in the past, a second authority, another kind, another parent, another clock.
            bus.publish(moving("hand", name, SECOND, authority=name), invalid="drop")
            bus.publish([moving("map", name, 3 * SECOND), moving("map", "arm", 4 * SECOND)])
            bus.publish(moving("arm", name, 2 * SECOND, authority=name))
            bus.publish(moving("hand", name, SECOND, authority=name), invalid="drop")
            bus.publish(static("map", "lamp", authority=name))
            bus.publish(moving("map", "lamp", SECOND, authority=name))
            bus.publish(moving(name, "hand", 5 * SECOND, authority=f"{name}2"))
            bus.publish(moving(name, "hand", 500 * SECOND, authority=name))
            with bus.subscribe(fails):
                bus.publish(moving(name, "hand", 501 * SECOND))
        check_logged(caplog, 7)


def test_no_name_forges_a_line_about_lookups_that_hang(caplog: pytest.LogCaptureFixture) -> None:
    async def hang() -> None:
        with Bus(clock) as bus, Buffer(bus) as buffer:
            bus.publish(moving("map", "base", 0))
            async with anyio.create_task_group() as tasks:
                for name in NAMES:
                    tasks.start_soon(buffer.lookup, "map", name)
                await bus.clock.sleep(60.0)
                tasks.cancel_scope.cancel()

    clock = SimulatedClock()
    anyio.run(simulate, clock, hang)
    check_logged(caplog, 1)


@pytest.fixture
def tfbus(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(monkeypatch, capsys)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return recorded(tmp_path / f"{BREAK} {CLEAR}.mcap", NAMES)


@pytest.fixture
def plain_recording(tmp_path: Path) -> Path:
    return recorded(tmp_path / "plain.mcap", PLAIN)


def recorded(path: Path, names: Sequence[str]) -> Path:
    """A recording with each name as a frame, an authority and a topic; two loops of parents are left out of it."""
    batches = [[moving("map", name, stamp * SECOND, stamp) for name in names] for stamp in range(4)]
    loops = [moving(names[0], "map", SECOND), moving(names[1], "map", SECOND)]
    lines: list[Any] = [
        *((number, "/tf", batch) for number, batch in enumerate(batches)),
        (4, "/tf", loops),
        (5, "/tf_static", [static("map", f"{name}'") for name in names]),
        *((6 + number, f"/{name}", [static("map", "lamp")]) for number, name in enumerate(names)),
    ]
    authorities = json.dumps([[name, 1] for name in names])
    return write_mcap(path, lines, metadata={"tfbus.authorities": authorities})


def test_no_name_forges_a_line_of_the_log_of_a_recording(
    recording: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    load(recording)
    check_logged(caplog, 2)

    async def record_in_vain() -> None:
        pipe = tmp_path / f"{NAMES[0]}.mcap"
        os.mkfifo(pipe)
        reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
        with Bus() as bus:
            async with Recorder(bus, pipe, overwrite=True) as recorder:
                os.close(reading)
                bus.publish(moving("map", "base", 1))
                await recorder.flush()
            assert recorder.error is not None
            lines_of(repr(recorder))

    anyio.run(record_in_vain)
    check_logged(caplog, 1)


# Commands


def check_output(done: Done, plain: Done) -> None:
    """Check that a command prints as many lines, and ends as it does with plain names."""
    assert done.returncode == plain.returncode
    for text, wanted in ((done.stdout, plain.stdout), (done.stderr, plain.stderr)):
        assert len(lines_of(text)) == len(lines_of(wanted))


OF_FILE = {
    "check": ("check", 0),
    "compare": ("compare", 0, 0),
    "convert": ("convert", 0, "NEW"),
    "info": ("info", 0),
    "info --wide": ("info", 0, "--wide"),
    "plot": ("plot", 0, "map", 1, "--text"),
    "query": ("query", 0, "map", 1, "map", 2),
    "query of nothing": ("query", 0, 1, "nothing"),
    "robot": ("robot", 0),
    "static": ("static", 0),
}
ON_DOMAIN = {
    "echo": ("echo", "map", 1),
    "echo of nothing": ("echo", 1, "nothing"),
    "monitor": ("monitor", "--once"),
    "monitor of a pair": ("monitor", "map", 1, "--once"),
    "static": ("static", 1, 2),
    "tree": ("tree",),
}
OF_BOTH = {"play": ("play", 0, "--rate", "inf"), "record": ("record", "NEW", "--duration", "0")}
# These print only names that their user gives, and texts of errors.
OWN = {"bridge", "broadcast", "demo", "foxglove", "listen", "rosbridge", "router", "view"}


def test_every_command_is_walked_or_prints_no_names() -> None:
    walked = {arguments[0] for arguments in (*OF_FILE.values(), *ON_DOMAIN.values(), *OF_BOTH.values())}
    assert walked | OWN == set(COMMANDS)
    assert walked.isdisjoint(OWN)


def filled(arguments: Sequence[object], file: Path, names: Sequence[str]) -> list[object]:
    """Arguments with a file for 0, a name for another number, and a new file for NEW."""
    places: dict[object, object] = {0: file, 1: names[0], 2: names[1], "NEW": file.with_name(f"{file.stem} new.mcap")}
    return [places.get(argument, argument) for argument in arguments]


IN_COLUMNS = [
    pytest.param(arguments, columns, marks=pytest.mark.thorough if columns and name != "info" else ())
    for name, arguments in OF_FILE.items()
    for columns in ("", "40")
]


@pytest.mark.parametrize(("arguments", "columns"), IN_COLUMNS)
def test_no_command_prints_a_name_of_a_file_as_it_is(
    recording: Path,
    plain_recording: Path,
    tfbus: Command,
    monkeypatch: pytest.MonkeyPatch,
    arguments: Sequence[object],
    columns: str,
) -> None:
    if "plot" in arguments:
        pytest.importorskip("matplotlib", reason="plots need matplotlib")
    monkeypatch.setenv("COLUMNS", columns)
    done = tfbus(*filled(arguments, recording, NAMES))
    if columns:
        # A name is long, and its line is broken.
        lines_of(done.stdout + done.stderr)
    else:
        check_output(done, tfbus(*filled(arguments, plain_recording, PLAIN)))


@pytest.mark.parametrize("arguments", ON_DOMAIN.values(), ids=ON_DOMAIN)
def test_no_command_prints_a_name_of_a_domain_as_it_is(tfbus: Command, arguments: Sequence[object]) -> None:
    def run(names: Sequence[str]) -> Done:
        async def publish(bus: Bus) -> None:
            for _ in range(8):
                bus.publish(moving("map", name, bus.clock.now(), authority=name) for name in names)
                await bus.clock.sleep(0.5)

        return tfbus.on_domain(publish, *filled(arguments, Path("none"), names))

    check_output(run(NAMES), run(PLAIN))


@pytest.mark.parametrize("arguments", OF_BOTH.values(), ids=OF_BOTH)
@pytest.mark.thorough
def test_no_command_between_a_file_and_a_domain_prints_a_name_as_it_is(
    recording: Path, plain_recording: Path, tfbus: Command, arguments: Sequence[object]
) -> None:
    def run(file: Path, names: Sequence[str]) -> Done:
        return tfbus.on_domain(nobody, *filled(arguments, file, names), clock=SystemClock())

    check_output(run(recording, NAMES), run(plain_recording, PLAIN))


def test_documents_for_programs_have_every_name_as_it_is(recording: Path, tmp_path: Path, tfbus: Command) -> None:
    document = json.loads(tfbus("info", recording, "--json").stdout)
    assert set(NAMES) <= {frame["frame"] for frame in document["frames"]}
    table = tfbus("compare", recording, recording, "--csv").stdout
    assert {f"map:{name}" for name in NAMES} == {row["pair"] for row in csv.DictReader(io.StringIO(table, newline=""))}
    yaml: Any = pytest.importorskip("yaml")
    statics = tmp_path / "static.yaml"
    tfbus("convert", recording, tmp_path / "new.mcap", "--static-to-yaml", statics)
    assert {each["child"] for each in yaml.safe_load(statics.read_text())} == {f"{name}'" for name in NAMES}


# Pictures


# A legend of all names is larger than the figure.
@pytest.mark.filterwarnings("ignore:Glyph", "ignore:constrained_layout")
@pytest.mark.parametrize(
    "kind",
    ["path", pytest.param("transforms", marks=pytest.mark.thorough), pytest.param("gaps", marks=pytest.mark.thorough)],
)
def test_figures_show_every_name_in_one_line_and_in_no_formula(kind: str, recording: Path) -> None:
    pytest.importorskip("matplotlib", reason="plots need matplotlib")
    from matplotlib.text import Text

    from tfbus import plot
    from tfbus.recording import open_recording

    tree = load(recording, problems=Counter())
    if kind == "gaps":
        with open_recording(recording) as opened:
            figure = plot.plot_gaps(plot.read_reception(opened.messages()))
        shown = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    else:
        draw = plot.plot_path if kind == "path" else plot.plot_transforms
        figure = draw(tree, FORMULA, *NAMES)
        legend = figure.legends[0] if figure.legends else figure.axes[0].get_legend()
        assert legend is not None
        shown = [text.get_text() for text in legend.get_texts()]
        assert [text for text in shown if text not in ("start", "end")] == shown[: len(NAMES)]
    # A formula that is none would end the drawing.
    figure.savefig(io.BytesIO(), format="svg")
    assert max(map(len, shown)) < 100
    texts = [text for artist in figure.findobj(Text) if (text := artist.get_text())]
    assert [text for text in texts if not text.isprintable()] == []
    assert {r"\$x^2\$", " _hidden", "[bold red]x[/bold red]", "größe 基座 🦾"} <= set(shown)


class _Document(html.parser.HTMLParser):
    """The texts and the elements of HTML."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: set[str] = set()
        self.texts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: object) -> None:  # noqa: ARG002 - the caller names it
        self.elements.add(tag)

    def handle_data(self, data: str) -> None:
        # Only the legend has this blank.
        self.texts += data.replace(" \xa0 ", "").split("\n")


@pytest.mark.parametrize("name", [*NAMES, HALF])
def test_html_has_every_name_as_a_printable_text(name: str) -> None:
    for text in htmls_with(name):
        document = _Document(text)
        assert document.elements <= {"pre", "span", "div", "table", "tr", "td", "br"}
        assert [text for text in document.texts if not text.isprintable()] == []


def htmls_with(name: str) -> Iterator[str]:
    tree = tree_with([name])
    yield html_of(tree)


def test_the_page_is_told_every_name_and_takes_it_back_and_its_texts_are_printable() -> None:
    pytest.importorskip("trimesh", reason="the live page needs trimesh")
    from tfbus.view.session import MAX_MESSAGE, Page, Session

    tree = tree_with([*NAMES, HALF])
    page = Page(tree)
    session = Session(page)
    for name in NAMES:
        for event in get_args(Event):
            hints = get_type_hints(event)
            page.note_event(event(**{field.name: value_of(hints[field.name], name) for field in fields(event)}))
        told = [json.loads(text) for text in session.picture(0, 0) if isinstance(text, str)]
        assert all(event["text"].isprintable() for each in told for event in each.get("events", ()))
    told = [json.loads(text) for text in Session(page).picture(0, 0) if isinstance(text, str)]
    [names] = [each["names"] for each in told if each["type"] == "frames"]
    assert sorted(names) == sorted(tree.frames())
    for name in names:
        order = json.dumps({"do": "select", "frame": name})
        if len(order) > MAX_MESSAGE:
            continue
        session.do(session.read(order))
        [chosen] = [each for each in map(json.loads, session.picture(0, 0)) if each["type"] == "selection"]
        assert chosen["frame"] == name
        assert all(fact.isprintable() for fact in chosen["facts"].values())

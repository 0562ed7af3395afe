"""The texts, facts, copies and plain data of errors."""

import builtins
import copy
import inspect
import json
import pickle
import re
from collections.abc import Iterator
from typing import Any

import pytest
from support.processes import peak_of
from support.samples import moving, tree_of

import tfbus
from tfbus import (
    LATEST,
    SECOND,
    AheadError,
    BusClosedError,
    ClockResetError,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    GapError,
    InvalidRobotError,
    InvalidTransformError,
    LookupTimeoutError,
    MissingRecordingError,
    PastExtrapolationError,
    PastLoop,
    RecordingError,
    RemoteLookupError,
    TooManyFramesError,
    TransformError,
    TransformLookupError,
    UnknownFrameError,
    errors,
    from_seconds,
)

CLASSES = {
    name: kind
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, Exception) and kind.__module__ == errors.__name__
}


def short_of(kind: type[Any], asked: float, oldest: float, newest: float, **facts: Any) -> Any:
    """An error of a frame of which samples are held from `oldest` to `newest`, in s."""
    stamps = {name: from_seconds(value) for name, value in {"oldest": oldest, "newest": newest, **facts}.items()}
    return kind(child="base_link", stamp=from_seconds(asked), authority="odometry", **stamps)


SHORT: FutureExtrapolationError = short_of(FutureExtrapolationError, 12.5, 2.09, 12.09)

ONE_OF_EACH: list[tuple[TransformError, str]] = [
    (TransformError("something is wrong"), "something is wrong"),
    (TransformLookupError("no transform"), "no transform"),
    (
        UnknownFrameError(frame="base_lnik", known=("base_link", "map", "base_laser")),
        "frame 'base_lnik' is not known, did you mean 'base_link' or 'base_laser'?",
    ),
    (
        DisconnectedError(target="map", source="tool0", roots=("map", "arm_base"), stamp=from_seconds(12.5)),
        "no path from 'tool0' to 'map': they are in different trees at 12.500 s, with roots 'map' and 'arm_base'",
    ),
    (
        ExtrapolationError(child="base_link", stamp=from_seconds(12.5), oldest=None, newest=None),
        "frame 'base_link': asked for 12.500 s, there is no sample in its window",
    ),
    (SHORT, "frame 'base_link': asked for 12.500 s, newest sample is 12.090 s (410 ms short), from 'odometry'"),
    (
        short_of(PastExtrapolationError, 1, 2.5, 12.5),
        "frame 'base_link': asked for 1.000 s, oldest sample is 2.500 s (1.5 s too early), from 'odometry'",
    ),
    (
        short_of(GapError, 3, 2.5, 12.5, slack=0.05, before=2.5, after=4.5, max_gap=0.5),
        "frame 'base_link': asked for 3.000 s within 50 ms, between samples at 2.500 s and 4.500 s, "
        "which are 2 s apart (at most 500 ms), from 'odometry'",
    ),
    (
        short_of(AheadError, 13, 2.5, 16),
        "frame 'base_link': asked for the latest up to 13.000 s, newest sample is 16.000 s (3 s too new), "
        "from 'odometry'",
    ),
    (
        LookupTimeoutError(target="map", source="base_link", timeout=0.25, missing=SHORT),
        "no transform from 'base_link' to 'map' within 0.25 s: "
        "frame 'base_link': asked for 12.500 s, newest sample is 12.090 s (410 ms short), from 'odometry'",
    ),
    (
        RemoteLookupError(domain="tf", robot="r1", reason="absent", detail="nobody offers it"),
        "no answer from the buffer of robot 'r1' in domain 'tf': nobody offers it",
    ),
    (
        RemoteLookupError(domain="tf", robot=None, reason="lost", detail="it has gone"),
        "no answer from a buffer without a robot in domain 'tf': it has gone",
    ),
    (
        InvalidTransformError(
            "frame 'a' cannot be its own parent", reason="self transform", parent="a", child="a", authority="odometry"
        ),
        "frame 'a' cannot be its own parent",
    ),
    (
        TooManyFramesError(frames=1_000, max_frames=1_000, parent="map", child="x", authority="page"),
        "the edge 'map' -> 'x' from 'page' names a new frame, but the bus has 1,000 frames and takes 1,000: remove "
        "frames that are gone, or make the bus with a greater max_frames",
    ),
    (
        InvalidRobotError("parent link 'arm' is not there", element='<joint name="elbow">'),
        "in <joint name=\"elbow\">: parent link 'arm' is not there",
    ),
    (RecordingError("the file is empty", path="run.mcap", reason="empty"), "recording 'run.mcap': the file is empty"),
    (MissingRecordingError(path="run.mcap"), "recording 'run.mcap': there is no such file"),
    (
        ClockResetError(before=from_seconds(90), after=from_seconds(3.5)),
        "the clock jumped back from 90.000 s to 3.500 s",
    ),
    (BusClosedError(), "the bus is closed"),
]


each_error = pytest.mark.parametrize(
    "error", [pytest.param(error, id=type(error).__name__) for error, _ in ONE_OF_EACH]
)


def facts(error: TransformError) -> dict[str, Any]:
    return {name: value for name, value in vars(error).items() if not name.startswith("_")}


def documented_tree() -> Iterator[tuple[str, str | None, str | None, list[str]]]:
    """Each line of the docstring's tree: the class, what it is drawn under, its builtin base, its attributes."""
    above: list[str] = []
    for line in inspect.getdoc(errors).splitlines():  # type: ignore[union-attr]
        found = re.fullmatch(r"( +)(\w+Error)(?: \((\w+)\))?( .*)?", line)
        if found:
            indent, name, builtin, rest = found.groups()
            depth = len(indent) // 4 - 1
            yield name, above[depth - 1] if depth else None, builtin, re.findall(r"\.(\w+)", rest or "")
            above[depth:] = [name]


def test_the_examples_of_this_file_have_every_class() -> None:
    assert {type(error) for error, _ in ONE_OF_EACH} == set(CLASSES.values())


def test_the_classes_form_the_tree_that_the_docstring_draws_and_have_its_attributes() -> None:
    drawn = {name: (parent, builtin) for name, parent, builtin, _ in documented_tree()}
    assert drawn.keys() == CLASSES.keys()
    for name, (parent, builtin) in drawn.items():
        bases = {CLASSES[parent] if parent else Exception, *([getattr(builtins, builtin)] if builtin else [])}
        assert set(CLASSES[name].__bases__) == bases, name
    for error, _ in ONE_OF_EACH:
        inherited = [kind.__name__ for kind in type(error).__mro__]
        assert all(hasattr(error, fact) for name, *_, facts in documented_tree() if name in inherited for fact in facts)


def test_every_error_class_is_exported() -> None:
    for name, kind in CLASSES.items():
        assert name in tfbus.__all__
        assert getattr(tfbus, name) is kind


@pytest.mark.parametrize(("error", "text"), ONE_OF_EACH, ids=lambda value: type(value).__name__)
def test_a_message_has_the_question_the_facts_and_the_difference(error: TransformError, text: str) -> None:
    assert str(error) == text
    assert repr(error) == f"{type(error).__name__}({text!r})"


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (UnknownFrameError(frame="map"), "frame 'map' is not known"),
        (UnknownFrameError(frame="map", known=("lidar",)), "frame 'map' is not known"),
        (UnknownFrameError(frame="/map"), "frame '/map' is not known, a frame name has no leading slash"),
        (
            UnknownFrameError(frame="//a", known=("a", "b")),
            "frame '//a' is not known, a frame name has no leading slash, did you mean 'a'?",
        ),
        (
            DisconnectedError(target="map", source="tool0", roots=("map", "arm_base")),
            "no path from 'tool0' to 'map': they are in different trees, with roots 'map' and 'arm_base'",
        ),
        (
            DisconnectedError(target="map", source="a", roots=("map", "a"), stamp=1, loop=("a", "b", "a")),
            "no path from 'a' to 'map': the frames a -> b -> a form a loop at 0.000000001 s",
        ),
        (
            FutureExtrapolationError(child="base_link", stamp=from_seconds(12.5), oldest=None, newest=None),
            "frame 'base_link': asked for 12.500 s, it has no samples",
        ),
        (
            PastExtrapolationError(child="base_link", stamp=from_seconds(12.5), oldest=None, newest=None),
            "frame 'base_link': asked for 12.500 s, it has no samples",
        ),
        (
            AheadError(child="base_link", stamp=from_seconds(12.5), oldest=None, newest=None),
            "frame 'base_link': asked for the latest up to 12.500 s, it has no samples",
        ),
        (
            FutureExtrapolationError(child="base_link", stamp=LATEST, oldest=None, newest=None, authority="odometry"),
            "frame 'base_link': asked for the latest, it has no samples, from 'odometry'",
        ),
        (
            FutureExtrapolationError(child="base_link", stamp=2_000_000_001, oldest=0, newest=2_000_000_000),
            "frame 'base_link': asked for 2.000000001 s, newest sample is 2.000 s (1 ns short)",
        ),
        (BusClosedError("the buffer is closed"), "the buffer is closed"),
    ],
)
def test_a_message_omits_unknown_facts(error: TransformError, text: str) -> None:
    assert str(error) == text


def test_similar_names_are_those_that_were_known_when_the_error_was_raised() -> None:
    known = ["map", "base_link"]
    error = UnknownFrameError(frame="base_lnik", known=known)
    known[:] = ["base_lnk"]
    assert error.close_matches == ("base_link",)
    assert "did you mean 'base_link'?" in str(error)
    assert pickle.loads(pickle.dumps(error)).close_matches == ("base_link",)
    tree = tree_of(moving("map", "base_link", 0))
    with pytest.raises(UnknownFrameError) as caught:
        tree.lookup("map", "base_lnik")
    tree.remove_frame("base_link")
    tree.insert(moving("map", "base_lnk", 0))
    assert caught.value.close_matches == ("base_link",)


class CountedName(str):
    """A frame name that counts how often it is compared in full."""

    compared = 0
    __slots__ = ()

    def __iter__(self) -> Iterator[str]:
        CountedName.compared += 1
        return super().__iter__()


def frames_of_many_robots() -> tuple[str, ...]:
    return tuple(CountedName(f"robot{robot}/joint_{joint}_link") for robot in range(500) for joint in range(10))


@pytest.mark.parametrize(
    "frame",
    [
        "robot77/joint_4_lnik",
        "robot77/joint_4_ink",
        "robto77/joint_4_link",
        "rboot77/joint_4_limk",
        "robot77_joint_4_link",
        "/robot77/joint_4_link",
    ],
)
def test_of_thousands_of_names_only_the_likely_ones_are_compared_in_full(frame: str) -> None:
    CountedName.compared = 0
    assert UnknownFrameError(frame=frame, known=frames_of_many_robots()).close_matches[0] == "robot77/joint_4_link"
    assert CountedName.compared <= errors.LOOKED_AT


def test_many_errors_about_one_frame_compute_similar_names_once() -> None:
    known = frames_of_many_robots()
    CountedName.compared = 0
    texts = {str(UnknownFrameError(frame="robot5/joint_4_linkk", known=known)) for _ in range(1_000)}
    assert len(texts) == 1
    assert 0 < CountedName.compared <= errors.LOOKED_AT


def test_only_so_many_names_of_a_bounded_length_are_compared_with_an_unknown_one() -> None:
    CountedName.compared = 0
    long = "x" * (errors.LONGEST_NAME + 1)
    assert UnknownFrameError(frame=long[:-1] + "y", known=[CountedName(long)]).close_matches == ()
    assert UnknownFrameError(frame="base", known=[CountedName(long), "bass"]).close_matches == ("bass",)
    assert CountedName.compared == 0
    many = [f"frame{number}" for number in range(errors.MOST_NAMES)]
    assert UnknownFrameError(frame="bass", known=[*many[1:], "base"]).close_matches == ("base",)
    assert UnknownFrameError(frame="bass", known=[*many, "base"]).close_matches == ()


def test_an_error_costs_the_same_however_many_frames_a_tree_has() -> None:
    tree = tree_of(*(moving("map", f"frame{number}", 0) for number in range(20_000)))
    raised: list[UnknownFrameError] = []

    def ask() -> None:
        try:
            tree.lookup("map", "frame")
        except UnknownFrameError as error:
            raised.append(error)

    # A pointer to each name that is kept, in a table and in a tuple; later errors share the tuple.
    assert peak_of(ask) < 200 * errors.MOST_NAMES
    assert peak_of(ask) < 10_000
    assert raised[0].close_matches == raised[1].close_matches != ()


def test_a_text_names_some_frames_of_a_long_loop() -> None:
    loop = (*(f"frame{number}" for number in range(100_000)), "frame0")
    error = DisconnectedError(target="a", source="b", roots=("a", "b"), stamp=SECOND, loop=loop)
    shown = " -> ".join(loop[:8])
    assert str(error) == f"no path from 'b' to 'a': the frames {shown} -> (99992 more) -> frame0 form a loop at 1.000 s"
    assert str(PastLoop(0, "frame0", "frame1", "me", SECOND, loop)).count("frame") < 20
    assert pickle.loads(pickle.dumps(error)).loop == loop


@each_error
@pytest.mark.parametrize("index", [None, 17])
def test_an_error_is_pickled_and_copied_with_its_facts_its_cause_its_notes_and_its_index(
    error: TransformError, index: int | None
) -> None:
    raised = raise_and_catch(error)
    raised.add_note("while the robot drove")
    if isinstance(raised, TransformLookupError) and index is not None:
        raised.index = index
        assert str(raised) == f"stamps[17]: {error}"
    pickled = (pickle.dumps(raised, protocol) for protocol in range(pickle.HIGHEST_PROTOCOL + 1))
    for twin in (*map(pickle.loads, pickled), copy.copy(raised), copy.deepcopy(raised)):
        assert twin is not raised
        assert_same_error(twin, raised)
        assert_same_error(twin.__cause__, SHORT)
        assert twin.__notes__ == ["while the robot drove"]


def raise_and_catch(error: TransformError) -> TransformError:
    try:
        raise copy.copy(error) from SHORT
    except TransformError as caught:
        return caught


def assert_same_error(twin: object, error: TransformError) -> None:
    assert isinstance(twin, type(error))
    assert str(twin) == str(error)
    assert twin.args == error.args
    for name, value in facts(error).items():
        assert getattr(twin, name) == value
    if isinstance(error, UnknownFrameError):
        assert isinstance(twin, UnknownFrameError)
        assert twin.close_matches == error.close_matches


def test_a_copy_without_a_cause_keeps_its_context() -> None:
    twin = copy.copy(BusClosedError())
    try:
        try:
            raise KeyError
        except KeyError:
            raise twin  # noqa: B904 - the context is what is tested
    except BusClosedError as error:
        assert isinstance(error.__context__, KeyError)
        assert not error.__suppress_context__


def test_a_subclass_of_a_program_pickles_too() -> None:
    error = SubclassError(child="tool0", stamp=3, oldest=1, newest=2)
    error.extra = "fact"
    twin = pickle.loads(pickle.dumps(error))
    assert_same_error(twin, error)
    assert twin.extra == "fact"


class SubclassError(FutureExtrapolationError):
    extra: str


def test_similar_names_are_looked_for_only_when_a_timeout_is_shown() -> None:
    CountedName.compared = 0
    missing = UnknownFrameError(frame="bse", known=[CountedName("base")])
    late = LookupTimeoutError(target="map", source="bse", timeout=1.0, missing=missing)
    assert CountedName.compared == 0
    assert str(late).endswith("did you mean 'base'?")
    assert CountedName.compared == 1


class Foreign(Exception):
    """An error of another library."""


@each_error
@pytest.mark.parametrize("index", [None, 3])
def test_an_error_comes_back_from_json_with_its_facts_and_its_cause(error: TransformError, index: int | None) -> None:
    sent = copy.copy(error)
    if isinstance(sent, TransformLookupError):
        sent.index = index
    sent.__cause__ = SHORT
    data = json.loads(json.dumps(sent.to_dict(), allow_nan=False))
    for kind in (type(sent), TransformError):
        back = kind.from_dict(data)
        assert type(back) is type(sent)
        assert str(back) == str(sent) == data["message"]
        # Facts that have a default need not be set.
        assert {name: getattr(back, name) for name in facts(sent)} == facts(sent)
        assert facts(sent).keys() <= data.keys()
        assert isinstance(back.__cause__, FutureExtrapolationError)
        assert facts(back.__cause__).items() >= facts(SHORT).items()


def test_a_foreign_cause_comes_back_as_its_text() -> None:
    error = BusClosedError()
    error.__cause__ = Foreign("broken")
    back = BusClosedError.from_dict(error.to_dict())
    assert repr(back.__cause__) == "Exception('Foreign: broken')"


@pytest.mark.parametrize(
    ("kind", "changes", "problem"),
    [
        (TransformError, {"type": "Exception"}, "not the data of a TransformError: type 'Exception'"),
        (TransformError, {"type": None}, "not the data of a TransformError"),
        (TransformError, {"message": 1}, "message 1"),
        (PastExtrapolationError, {}, "not the data of a PastExtrapolationError"),
        (TransformError, {"args": []}, "has no field 'args'"),
        (TransformError, {"__class__": 1}, "has no field '__class__'"),
        (TransformError, {"child": 5}, "FutureExtrapolationError.child cannot be 5"),
        (TransformError, {"stamp": "soon"}, "FutureExtrapolationError.stamp cannot be 'soon'"),
        (TransformError, {"cause": "none"}, "FutureExtrapolationError.cause cannot be 'none'"),
        (TransformError, {"newest": ...}, "needs the field 'newest'"),
    ],
)
def test_wrong_data_of_an_error_are_refused(kind: type[TransformError], changes: dict[str, Any], problem: str) -> None:
    data = {name: value for name, value in {**SHORT.to_dict(), **changes}.items() if value is not ...}
    with pytest.raises(ValueError, match=problem):
        kind.from_dict(data)

"""A recording becomes a tree, with the answers of tf2."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin
from support.recorded import SMALL, WRONG_IN_SMALL, Line, answers, as_ros2, write_mcap, write_recording
from support.samples import any_samples, moving, over, static, x_of

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    DisconnectedError,
    ExtrapolationError,
    Transform,
    TransformLookupError,
    TransformStamped,
    TransformTree,
    UnknownFrameError,
)
from tfbus.recording import load, open_recording
from tfbus.recording.recording import MAX_DETAILS, Problems, SpeedLimit, fill
from tfbus.tf_message import MalformedMessageError

TOLERANCE = 1e-9

ERRORS: dict[str, type[TransformLookupError]] = {
    "LookupException": UnknownFrameError,
    "ConnectivityException": DisconnectedError,
    "ExtrapolationException": ExtrapolationError,
}


def disagreement(tree: TransformTree, answer: dict[str, Any]) -> str:
    """The answers of the tree that differ from those of tf2."""
    at = LATEST if answer["at"] is None else answer["at"]
    try:
        found = tree.lookup(answer["target"], answer["source"], at)
    except TransformLookupError as error:
        expected = ERRORS.get(answer.get("error", ""))
        return "" if expected and isinstance(error, expected) else f"{answer}: {error}"
    if "error" in answer:
        return f"{answer}: {found}"
    # tf2 gives all that is static the stamp 0; tests/golden/README.md says why tfbus does not.
    stamp = answer["at"] or (0 if found.static else found.stamp)
    away = math.dist(found.transform.translation, answer["translation"])
    # Up to their sign. Unit quaternions are half as far apart as the rotations.
    turned = 2 * min(
        math.dist(found.transform.rotation, [sign * part for part in answer["rotation"]]) for sign in (1.0, -1.0)
    )
    same = stamp == answer["stamp"] and away <= TOLERANCE and turned <= TOLERANCE
    return "" if same else f"{answer}: {found}, {away} m and {turned} rad away"


@pytest.mark.parametrize(
    "kind",
    [
        "bag",
        "db3",
        "mcap",
        *(pytest.param(f"folder of {kind}", marks=pytest.mark.thorough) for kind in ("db3", "mcap")),
    ],
)
def test_a_loaded_recording_gives_the_answers_of_tf2_in_every_format(tmp_path: Path, kind: str) -> None:
    path = SMALL
    if kind != "bag":
        path = as_ros2(SMALL, tmp_path / "bag", StoragePlugin.MCAP if "mcap" in kind else StoragePlugin.SQLITE3)
        if "folder" not in kind:
            (path,) = path.glob(f"*.{kind}")
    problems: Counter[str] = Counter()
    tree = load(path, problems=problems)
    asked = answers()
    assert len(asked) > 450
    assert [line for answer in asked if (line := disagreement(tree, answer))] == []
    assert problems == WRONG_IN_SMALL


def test_samples_are_kept_however_old_they_are(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", over("a", "b", (0, 1_000_000 * SECOND), speed=1e-9))])
    tree = load(path)
    assert tree.keep is None
    assert x_of(tree, "a", "b", 250_000 * SECOND) == pytest.approx(250_000.0)


def test_an_authority_that_joins_another_in_a_long_recording_is_loaded_too(path: Path) -> None:
    senders = [1 if k > 1_000 and k % 2 else 0 for k in range(1_200)]
    entries = [(k, (moving("a", "b", k, float(k), f"sender {one}"),)) for k, one in enumerate(senders)]
    tree = load(write_recording(path, *entries))
    (edge,) = tree.edges()
    assert edge.samples == 1_200
    assert [x_of(tree, "a", "b", k) for k in (999, 1_100, 1_101)] == [999.0, 1_100.0, 1_101.0]


def test_a_range_has_its_own_samples_and_the_static_ones_from_before(path: Path) -> None:
    lines = [
        (0, "/tf_static", [static("b", "fixed", 5.0)]),
        *((time, "/tf", [moving("a", "b", time + 1_000, float(time))]) for time in range(10, 60, 10)),
    ]
    tree = load(write_mcap(path, lines), 20, 40)
    (edge, fixed) = tree.edges()
    assert (edge.child, edge.samples, edge.oldest, edge.newest) == ("b", 3, 1_020, 1_040)
    assert fixed.static
    assert x_of(tree, "a", "fixed", 1_030) == 35.0


def test_a_loop_of_parents_is_left_out_and_the_rest_of_its_message_is_not(path: Path) -> None:
    lines = [(1, "/tf", [moving("a", "b", 1)]), (2, "/tf", [moving("b", "a", 2), moving("a", "c", 2, 7.0)])]
    problems: Counter[str] = Counter()
    tree = load(write_mcap(path, lines), problems=problems)
    assert problems == {"cycle": 1}
    assert tree.chain("c", "b") == ["c", "a", "b"]
    assert tree.frames() == ["a", "b", "c"]
    assert x_of(tree, "a", "c") == 7.0


@given(batches=st.lists(st.lists(any_samples("abcd", last=20), min_size=1, max_size=4), max_size=15))
def test_the_tree_has_the_samples_that_a_bus_would_accept(
    tmp_path_factory: pytest.TempPathFactory, batches: list[list[TransformStamped]]
) -> None:
    # A message is of one kind.
    parts = [[sample for sample in batch if sample.static == kind] for batch in batches for kind in (True, False)]
    lines = [(time, "/tf_static" if part[0].static else "/tf", part) for time, part in enumerate(parts) if part]
    problems: Counter[str] = Counter()
    tree = load(write_mcap(tmp_path_factory.mktemp("recording") / "run.mcap", lines), problems=problems)
    bus = Bus()
    buffer = Buffer(bus, keep=None)
    for _, _, part in lines:
        bus.publish(part, invalid="drop")
    assert problems == bus.statistics().rejected
    assert tree.edges() == buffer.tree.edges()
    assert tree.to_yaml() == buffer.tree.to_yaml()


def test_without_a_counter_the_problems_are_logged_in_one_line(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    load(SMALL)
    (record,) = caplog.records
    assert record.getMessage().startswith(f"left out of {SMALL}: 3 x not finite, 2 x frame name, ")
    caplog.clear()
    problems = Counter({"cycle": 10})
    load(SMALL, problems=problems)
    load(write_mcap(path, [(1, "/tf", [moving("a", "b", 1)])]))
    assert (problems["cycle"], caplog.records) == (11, [])


def test_what_is_not_read_although_it_may_hold_transforms_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, f"/{name}/tf", [moving("a", "b", 1)]) for name in ("r1", "r2")])
    load(path)
    assert [record.getMessage() for record in caplog.records] == [
        f"{path}: not read: 1 messages on topic /{name}/tf of type tf2_msgs/msg/TFMessage" for name in ("r1", "r2")
    ]


def test_the_progress_of_filling_a_tree_is_told_in_messages_read() -> None:
    told: list[int] = []
    tree = TransformTree(keep=None)
    with open_recording(SMALL) as recording:
        fill(tree, recording, Problems(), progress=told.append)
        assert sum(told) == recording.count
    assert tree.edges() == load(SMALL, problems=Counter()).edges()


def test_the_details_of_damaged_messages_are_kept_up_to_a_number() -> None:
    problems = Problems()
    for number in range(MAX_DETAILS + 1):
        problems.note((MalformedMessageError("damaged", f"number {number}"),))
    assert problems["damaged"] == MAX_DETAILS + 1
    assert problems.details == [f"number {number}" for number in range(MAX_DETAILS)]


def test_a_frame_has_the_parent_of_each_time(path: Path) -> None:
    lines: list[Line] = [(time, "/tf", [moving("a" if time < 5 else "z", "b", time)]) for time in range(10)]
    lines.insert(0, (0, "/tf_static", [static("root", "a"), static("root", "z")]))
    tree = load(write_mcap(path, lines))
    assert (tree.parent("b", 3), tree.parent("b", 7)) == ("a", "z")


def test_a_translation_that_is_not_physical_is_left_out_unless_the_bound_is_raised(tmp_path: Path) -> None:
    far = moving("map", "a", 2, 1e13)
    lines = [(1, "/tf", [moving("map", "a", 1), far]), (3, "/tf", [moving("map", "a", 3, -1e13)])]
    path = write_mcap(tmp_path / "run.mcap", lines)
    problems: Counter[str] = Counter()
    assert load(path, problems=problems).edges()[0].samples == 1
    assert problems == {"not physical": 2}
    wide = load(path, problems=problems, max_translation=1e13)
    assert (wide.edges()[0].samples, wide.max_translation) == (3, 1e13)
    with pytest.raises(ValueError, match="max_translation"):
        load(path, max_translation=0.0)


@pytest.mark.parametrize("far", [(3e3, 0.0, 0.0), (0.0, 3e3, 0.0), (0.0, 0.0, 3e3)])
def test_a_long_recording_is_loaded_in_blocks_as_message_by_message(
    path: Path, far: tuple[float, float, float]
) -> None:
    lines = [(10 * k, moving("a", "b", 10 * k, float(k))) for k in range(2_000)]
    # The same instant again: the sample that comes later counts.
    lines.insert(1_500, (14_990, moving("a", "b", 14_990, -1.0)))
    # A sample beyond the bound of translations, in the second block.
    lines.insert(1_600, (15_990, TransformStamped("a", "b", 15_995, Transform(far))))
    write_recording(path, *((received, (sample,)) for received, sample in lines))
    problems: Counter[str] = Counter()
    tree = load(path, problems=problems, max_translation=2_500.0)
    assert problems == {"not physical": 1}
    (edge,) = tree.edges()
    assert (edge.samples, edge.oldest, edge.newest) == (2_000, 0, 19_990)
    asked = [0, 5, 9_990, 14_980, 14_990, 15_000, 17_995, 19_990]
    expected = [0.0, 0.5, 999.0, 1_498.0, -1.0, 1_500.0, 1_799.5, 1_999.0]
    assert [x_of(tree, "a", "b", stamp) for stamp in asked] == expected
    assert (tree.inserted, tree.replaced, tree.expired) == (2_000, 1, 0)
    tree.insert(moving("a", "b", 20_000, 2_000.0))
    assert x_of(tree, "a", "b", 19_995) == 1_999.5


def kept(*places: float, speed: float = 2.0) -> tuple[list[float], Counter[str]]:
    """The indices of those of some places, one a second, that stay."""
    limit = SpeedLimit(speed)
    found: list[TransformStamped] = []
    for at, x in enumerate(places):
        found += limit.admit((moving("a", "b", at * SECOND, x),))
    found += limit.undecided()
    # Each of them once.
    assert limit.undecided() == ()
    return [sample.transform.translation[0] for sample in found], limit.dropped


@pytest.mark.parametrize(
    ("places", "stay"),
    [
        ([0, 1, 100, 3, 5], [0, 1, 3, 5]),
        ([0, 2, 4], [0, 2, 4]),
        # The first sample goes if the next ones contradict it.
        ([1e9, 0, 1, 2], [0, 1, 2]),
        ([0, 1e9, 1, 2], [0, 1, 2]),
        ([7], [7]),
        ([0, 1e9], [0]),
        ([0, 1e9, -1e9, 5e9], [0]),
        # A frame that really is elsewhere is reached in time.
        ([0, 0, 5, 5, 5], [0, 0, 5]),
    ],
)
def test_a_sample_that_is_too_far_from_the_others_is_dropped(places: list[float], stay: list[float]) -> None:
    gone = len(places) - len(stay)
    assert kept(*places) == (stay, {"speed": gone} if gone else {})


def test_candidates_are_bounded() -> None:
    places = [1e3 * 4**k for k in range(40)]
    # The oldest one is forgotten, so a sample that comes back to its place confirms nothing.
    for back, gone in (([], 39), (places[:1], 40)):
        found, dropped = kept(*places, *back)
        assert (len(found), dropped) == (1, {"speed": gone})


def test_frames_parents_and_kinds_are_apart() -> None:
    limit = SpeedLimit(1.0)
    first = (moving("a", "b", 0), moving("a", "c", 0, 50.0), static("b", "d", 9e9))
    assert limit.admit(first) == (first[2],)
    second = (moving("a", "b", SECOND, 1.0), moving("z", "b", SECOND, 900.0), moving("a", "c", SECOND, 51.0))
    assert limit.admit(second) == (first[0], second[0], first[1], second[2])
    # Of one stamp, the last one wins: no speed is known.
    third = (moving("a", "b", SECOND, 80.0),)
    assert limit.admit(third) == third


@pytest.mark.parametrize(("speed", "error"), [(0.0, ValueError), (-1.0, ValueError), ("fast", TypeError)])
def test_a_speed_is_a_number_greater_than_zero(speed: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match="max_speed"):
        SpeedLimit(speed)


def test_load_leaves_out_what_nothing_can_have_reached(tmp_path: Path) -> None:
    # So many would be stored at once.
    places = [5e9, *range(1_000), 7e7, *range(1_000, 2_000)]
    lines = [(at, "/tf", [moving("map", "base", at * SECOND, float(x))]) for at, x in enumerate(places)]
    path = write_mcap(tmp_path / "run.mcap", [*lines, (9_000, "/tf", [moving("map", "lone", 0, 5.0)])])
    problems: Counter[str] = Counter()
    tree = load(path, max_speed=3.0, problems=problems)
    assert {edge.child: edge.samples for edge in tree.edges()} == {"base": 2_000, "lone": 1}
    assert problems == {"speed": 2}

"""Local names, by themselves and where two robots with the same frames share a bus."""

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import product
from typing import Any

import anyio
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.asking import Asked, driving, settle
from support.samples import any_samples, static, x_of

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    DisconnectedError,
    FutureExtrapolationError,
    InvalidTransformError,
    LookupTimeoutError,
    PointStamped,
    Question,
    SimulatedClock,
    Transform,
    TransformBroadcaster,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.frames import Prefix

pytestmark = pytest.mark.anyio


def at_x(x: float) -> Transform:
    return Transform((x, 0.0, 0.0))


def two_robots(start: int = 0) -> tuple[SimulatedClock, Bus, list[TransformBroadcaster], list[Buffer]]:
    """Robot 1 at x = 1 m in the map and robot 2 at 20 m, each with an arm 0.5 m further."""
    clock = SimulatedClock(start)
    bus = Bus(clock)
    broadcasters = [TransformBroadcaster(bus, f"r{i}", prefix=f"robot{i}/", shared={"map"}) for i in (1, 2)]
    buffers = [Buffer(bus, prefix=f"robot{i}/", shared={"map"}) for i in (1, 2)]
    for broadcaster, x in zip(broadcasters, (1.0, 20.0), strict=True):
        broadcaster.send("map", "base", at_x(x), at=SECOND)
        broadcaster.send_static("base", "arm", at_x(0.5))
    return clock, bus, broadcasters, buffers


@pytest.mark.parametrize(
    ("prefix", "shared", "error"),
    [
        pytest.param("", set(), ValueError, id="empty"),
        pytest.param("/robot1/", set(), ValueError, id="leading slash"),
        pytest.param(5, set(), TypeError, id="number"),
        pytest.param("robot1/", "map", TypeError, id="one shared name"),
        pytest.param("robot1/", {""}, ValueError, id="empty shared name"),
        pytest.param("robot1/", {"/map"}, ValueError, id="shared name with a slash"),
        pytest.param("robot1/", {5}, TypeError, id="shared number"),
        pytest.param("robot1/", {"robot1/map"}, ValueError, id="shared name with the prefix"),
        pytest.param(None, {"map"}, TypeError, id="shared name without a prefix"),
    ],
)
@pytest.mark.parametrize("make", [partial(TransformBroadcaster), partial(Buffer)], ids=["broadcaster", "buffer"])
def test_a_bad_prefix_is_an_error(
    bus: Bus, make: Callable[..., object], prefix: Any, shared: Any, error: type[Exception]
) -> None:
    with pytest.raises(error):
        make(bus, prefix=prefix, shared=shared)
    assert bus.statistics().buffers == ()


# Two robots


def test_two_robots_with_the_same_local_names_are_separate() -> None:
    _, bus, _, (first, second) = two_robots()
    assert first.lookup_nowait("map", "arm").transform == at_x(1.5)
    assert second.lookup_nowait("map", "arm").transform == at_x(20.5)
    assert first.tree.frames() == ["map", "robot1/arm", "robot1/base", "robot2/arm", "robot2/base"]
    assert bus.statistics().reparented == bus.statistics().authority_conflicts == 0


def test_a_buffer_without_a_prefix_sees_one_robot_from_the_other_through_the_map() -> None:
    _, bus, (first, second), _ = two_robots()
    everything = Buffer(bus)
    first.send("map", "base", at_x(1.0), at=2 * SECOND)
    assert not everything.can_transform("robot1/arm", "robot2/arm")
    second.send("map", "base", at_x(30.0), at=2 * SECOND)
    found = everything.lookup_nowait("robot1/arm", "robot2/base")
    assert (found.parent, found.child, found.transform) == ("robot1/arm", "robot2/base", at_x(28.5))
    assert x_of(everything.tree, "robot2/arm", "robot1/base") == -29.5


async def test_answers_have_the_local_names_of_the_question() -> None:
    _, _, _, (robot, _) = two_robots()
    for answer in (
        robot.lookup_nowait("map", "arm"),
        robot.lookup_nowait("map", "arm", SECOND, source_at=SECOND, fixed="base"),
        await robot.lookup("map", "arm"),
        await robot.lookup("map", "arm", SECOND, source_at=SECOND, fixed="base"),
        await robot.lookup("map", "arm", SECOND, tolerance=1.0),
    ):
        assert (answer.parent, answer.child, answer.stamp, answer.transform) == ("map", "arm", SECOND, at_x(1.5))


async def test_data_have_local_names_before_and_after_transform() -> None:
    _, _, _, (_, robot) = two_robots()
    point = PointStamped("arm", LATEST, (0.0, 0.0, 1.0))
    expected = PointStamped("map", SECOND, (20.5, 0.0, 1.0))
    assert robot.transform_nowait(point, "map") == expected
    assert await robot.transform(point, "map") == expected
    assert robot.transform_nowait(expected, "arm", at=SECOND, fixed="base").point == (0.0, 0.0, 1.0)


def test_owning_a_local_name_reserves_the_frame_of_that_robot_only() -> None:
    _, bus, (first, second), (robot, other) = two_robots()
    with first.owning("tool"), second.owning("tool"):
        first.send_static("arm", "tool", at_x(0.25))
        second.send_static("arm", "tool", at_x(0.5))
        assert x_of(robot.tree, "map", "robot1/tool") == 1.75
        with pytest.raises(InvalidTransformError):
            TransformBroadcaster(bus, "stranger").send_static("robot1/arm", "robot1/tool", at_x(0.0))
    assert not robot.can_transform("arm", "tool")
    assert not other.can_transform("arm", "tool")
    assert robot.can_transform("map", "arm")


@pytest.mark.parametrize("bad", ["", "/arm"])
async def test_an_invalid_name_raises_at_once(bad: str) -> None:
    _, _, _, (robot, _) = two_robots()
    with pytest.raises(UnknownFrameError) as caught:
        await robot.lookup("map", bad)
    assert caught.value.frame == bad
    with pytest.raises(UnknownFrameError), robot.watch("map", bad):
        pass


def test_a_buffer_with_a_prefix_cannot_name_frames_of_another_robot() -> None:
    _, _, _, (robot, _) = two_robots()
    # The buffer keeps the path of an answer by its names on the bus.
    robot.lookup_nowait("map", "arm")
    for name in ("robot2/arm", "robot1/arm", "/robot2/arm"):
        assert not robot.can_transform("map", name)
        with pytest.raises(UnknownFrameError):
            robot.lookup_nowait("map", name)


async def test_a_waiting_lookup_is_listed_with_local_names_and_blocked_by_bus_names() -> None:
    clock, _, (first, second), (robot, _) = two_robots()
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, lambda: robot.lookup("map", "arm", 2 * SECOND))
        late = Asked(tasks, lambda: robot.lookup("map", "arm", 3 * SECOND, timeout=4.0))
        travels = Asked(tasks, lambda: robot.lookup("map", "tool", 2 * SECOND, source_at=SECOND, fixed="base"))
        await settle()
        assert {pending.question for pending in robot.pending()} == {
            Question("map", "arm", 2 * SECOND),
            Question("map", "arm", 3 * SECOND),
            Question("map", "tool", 2 * SECOND, SECOND, "base"),
        }
        assert "waiting: 'arm' in 'map': frame 'robot1/base': asked for 2.000 s" in robot.describe()
        second.send("map", "base", at_x(21.0), at=2 * SECOND)
        await settle()
        assert not asked.ended
        first.send("map", "base", at_x(3.0), at=2 * SECOND)
        await settle()
        assert (asked.answer.parent, asked.answer.child, asked.answer.transform) == ("map", "arm", at_x(3.5))
        first.send_static("base", "tool", at_x(0.25))
        await settle()
        assert (travels.answer.child, travels.answer.transform) == ("tool", at_x(3.25))
        await clock.advance(5.0)
        assert isinstance(late.error, LookupTimeoutError)
        assert (late.error.target, late.error.source) == ("map", "robot1/arm")


async def test_a_long_wait_is_logged_with_bus_names(caplog: pytest.LogCaptureFixture) -> None:
    clock, _, _, (robot, _) = two_robots()
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, lambda: robot.lookup("map", "aarm"))
        await settle()
        with caplog.at_level(logging.WARNING, "tfbus"):
            await clock.advance(6.0)
        asked.cancel()
    assert "'robot1/aarm' in 'map'" in caplog.text


async def test_a_watch_gives_local_names() -> None:
    _, _, (first, second), (robot, _) = two_robots()
    with robot.watch("map", "arm") as changes:
        async with anyio.create_task_group() as tasks:
            asked = Asked(tasks, lambda: anext(changes))
            await settle()
            assert (asked.answer.parent, asked.answer.child, asked.answer.transform) == ("map", "arm", at_x(1.5))
            asked = Asked(tasks, lambda: anext(changes))
            await settle()
            second.send("map", "base", at_x(21.0), at=2 * SECOND)
            await settle()
            assert not asked.ended
            first.send("map", "base", at_x(2.0), at=2 * SECOND)
            await settle()
            assert (asked.answer.parent, asked.answer.child, asked.answer.transform) == ("map", "arm", at_x(2.5))
        assert changes.skipped == 0


# Pictures


def test_describe_has_local_names_and_marks_frames_of_others() -> None:
    _, bus, _, (robot, _) = two_robots(SECOND)
    bus.publish([static("earth", "map"), driving("map", "base", 1.0)])
    assert robot.describe().splitlines() == [
        "/earth",
        "└── map                  static",
        "    ├── /base            one sample  age 0 ns  span 0 ns",
        "    ├── /robot2/base     one sample  age 0 ns  span 0 ns  from 'r2'",
        "    │   └── /robot2/arm  static  from 'r2'",
        "    └── base             one sample  age 0 ns  span 0 ns  from 'r1'",
        "        └── arm          static  from 'r1'",
    ]
    assert "robot1/base" in robot.tree.describe()


def test_an_explanation_has_local_names_and_its_errors_have_bus_names() -> None:
    _, bus, _, (robot, _) = two_robots()
    found = robot.explain("map", "arm", 2 * SECOND)
    assert (found.target, found.source, found.chain) == ("map", "arm", ("map", "base", "arm"))
    assert [(edge.parent, edge.child) for edge in found.edges] == [("map", "base"), ("base", "arm")]
    (error,) = found.errors
    assert isinstance(error, FutureExtrapolationError)
    assert error.child == "robot1/base"
    assert str(found).splitlines()[1].startswith("! map <- base ")
    bus.publish(static("raft", "robot1/boat"))
    apart = robot.explain("boat", "arm")
    assert apart.half_chains == (("boat", "/raft"), ("arm", "base", "map"))
    assert isinstance(apart.errors[0], DisconnectedError)
    misspelt = robot.explain("map", "/arm")
    assert (misspelt.source, misspelt.answerable) == ("/arm", False)


names = st.text("ab/_", min_size=1, max_size=6).filter(lambda name: not name.startswith("/"))


# Prefixes


@given(names, st.sets(names, max_size=3), names)
def test_a_local_name_survives_the_way_to_the_bus_and_back(text: str, shared: set[str], name: str) -> None:
    assume(not any(other.startswith(text) for other in shared))
    prefix = Prefix(text, shared)
    assert prefix.local(prefix.on_bus(name)) == name
    # A frame without a local name gets a leading slash.
    local = prefix.local(name)
    assert local == f"/{name}" if local.startswith("/") else prefix.on_bus(local) == name


@given(st.lists(st.lists(any_samples("abc", 20), max_size=4) | st.sampled_from(["a", "jump"]), max_size=8))
def test_a_buffer_with_a_prefix_answers_as_one_without_whatever_was_asked_before(steps: list[Any]) -> None:
    clock = SimulatedClock(100)
    with (
        Bus(clock, max_ahead=None) as bus,
        Buffer(bus, 10e-9) as plain,
        Buffer(bus, 10e-9, prefix="r/", shared={"a"}) as local,
    ):
        robot = TransformBroadcaster(bus, prefix="r/", shared={"a"}, invalid="drop")
        for step in steps:
            if step == "jump":
                clock.set(clock.now() - 1)
            elif step == "a":
                with suppress(UnknownFrameError):
                    bus.remove_frame("a")
            else:
                robot.send_all(step)
            # Twice, because the second answer may come from what the first one has found.
            for at in (LATEST, 7, 7, LATEST):
                for target, source in product("abc", repeat=2):
                    above, below = (name if name == "a" else "r/" + name for name in (target, source))
                    found, expected = (
                        answer_or_error(local, target, source, at),
                        answer_or_error(plain, above, below, at),
                    )
                    assert found == expected


def answer_or_error(buffer: Buffer, target: str, source: str, at: Any) -> Any:
    """All of an answer but its names, or the text of its error."""
    try:
        answer = buffer.lookup_nowait(target, source, at)
    except TransformLookupError as error:
        return str(error)
    assert (answer.parent, answer.child) == (target, source)
    return answer.stamp, answer.transform, answer.static

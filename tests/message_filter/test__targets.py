from functools import partial
from typing import Any

import anyio
import pytest
from support.asking import Asked, settle
from support.samples import moving, static

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    DisconnectedError,
    FutureExtrapolationError,
    LookupTimeoutError,
    PastExtrapolationError,
    SimulatedClock,
    TransformStamped,
    UnknownFrameError,
)
from tfbus.message_filter.message_filter import Targets
from tfbus.stamps import STAMP_MAX


def make(target: Any, tolerance: float = 0.0) -> tuple[Bus, Targets[Any]]:
    bus = Bus(SimulatedClock())
    return bus, Targets(Buffer(bus), target, tolerance)


def test_one_target_gives_a_transform_and_several_give_a_tuple() -> None:
    for target, expected in (("map", "map"), (["map"], ("map",)), (("map", "odom"), ("map", "odom"))):
        bus, targets = make(target)
        bus.publish([static("map", "odom"), moving("odom", "laser", 5)])
        answer = targets.lookup_nowait("laser", 5)
        parents = answer.parent if isinstance(answer, TransformStamped) else tuple(each.parent for each in answer)
        assert parents == expected


def test_a_target_that_is_the_frame_of_the_message_needs_no_lookup() -> None:
    bus, targets = make("laser", tolerance=1.0)
    assert list(targets.questions("laser", 5)) == []
    answer = targets.lookup_nowait("laser", 5)
    assert (answer.parent, answer.child, answer.stamp, answer.static) == ("laser", "laser", 5, True)
    bus.clock.set(8)  # type: ignore[attr-defined]
    assert targets.lookup_nowait("laser", LATEST).stamp == 8


def test_a_tolerance_requires_the_stamp_after_it_and_answers_at_the_stamp() -> None:
    bus, targets = make("map", tolerance=2.0)
    assert list(targets.questions("laser", 5)) == [("map", 5 + 2 * SECOND), ("map", 5)]
    assert list(targets.questions("laser", LATEST)) == [("map", LATEST)]
    assert list(targets.questions("laser", STAMP_MAX)) == [("map", STAMP_MAX), ("map", STAMP_MAX)]
    bus.publish(moving("map", "laser", 5, x=1.0))
    assert isinstance(targets.blocker("laser", 5), FutureExtrapolationError)
    bus.publish(moving("map", "laser", 5 + 2 * SECOND))
    assert targets.blocker("laser", 5) is None
    assert (targets.lookup_nowait("laser", 5).stamp, targets.lookup_nowait("laser", 5).transform.translation[0]) == (
        5,
        1.0,
    )


def test_the_blocker_is_an_error_that_waiting_cannot_help_before_one_that_it_may() -> None:
    bus, targets = make(["nowhere", "map"])
    bus.publish(moving("map", "laser", 5))
    assert isinstance(targets.blocker("laser", 6), UnknownFrameError)
    assert isinstance(targets.blocker("laser", 4), PastExtrapolationError)


def test_at_the_deadline_a_missing_transform_is_a_timeout_that_names_its_target() -> None:
    bus, targets = make(["odom", "map"])
    bus.publish([moving("odom", "laser", 5), static("map", "door")])
    with pytest.raises(LookupTimeoutError) as caught:
        targets.lookup_at_timeout("laser", 5, 3.0)
    assert (caught.value.target, caught.value.source, caught.value.timeout) == ("map", "laser", 3.0)
    assert isinstance(caught.value.__cause__, DisconnectedError)
    with pytest.raises(PastExtrapolationError):
        targets.lookup_at_timeout("laser", 4, 3.0)
    bus.publish(static("map", "odom"))
    assert len(targets.lookup_at_timeout("laser", 5, 3.0)) == 2


@pytest.mark.anyio
async def test_waiting_ends_when_each_lookup_has_had_an_answer() -> None:
    bus, targets = make(["odom", "map"])
    async with anyio.create_task_group() as tasks:
        waiting = Asked(tasks, partial(targets.wait, "laser", 5))
        bus.publish(moving("odom", "laser", 5))
        await settle()
        assert not waiting.ended
        bus.publish(static("map", "odom"))
        await settle()
        assert waiting.answer is None


def test_targets_may_not_change_between_one_and_several() -> None:
    _, one = make("map")
    one.replace("odom")
    assert [target for target, _ in one.questions("laser", 5)] == ["odom"]
    _, several = make(["map"])
    several.replace(["odom", "world"])
    assert [target for target, _ in several.questions("laser", 5)] == ["odom", "world"]
    with pytest.raises(TypeError, match="one target"):
        one.replace(["map"])
    with pytest.raises(TypeError, match="a sequence"):
        several.replace("map")

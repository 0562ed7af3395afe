import re
from typing import Any

import numpy as np
import pytest

from tfbus import LATEST, LaserScan, Latest, PointStamped, Question, TransformStamped, do_transform
from tfbus.tree.lookup import Policy, question_of

POLICY = Policy(tolerance=5)


@pytest.mark.parametrize("at", [5, LATEST])
@pytest.mark.parametrize(
    "more", [{"source_at": 5}, {"source_at": 0}, {"fixed": "map"}, {"max_age": 0.0}, {"policy": Policy()}]
)
def test_only_a_question_of_nothing_but_a_stamp_is_plain(at: int | Latest, more: dict[str, Any]) -> None:
    assert Question("map", "tool", at).is_plain
    question, same = (Question("map", "tool", at, **more) for _ in range(2))
    assert not question.is_plain
    assert {question: "found"}[same] == "found"


class Smell:
    """Data with a frame and a stamp, of a type that is not registered."""

    frame = "map"
    stamp = LATEST


class Message:
    """Registered data that have their frame and stamp in a header, as a message of ROS."""

    header = ("base", 0)


class Note:
    """Registered data with a frame, but no stamp."""

    frame = "map"


@do_transform.register
def _(data: Note, transform: TransformStamped) -> Note:  # noqa: ARG001
    return data


@do_transform.register
def _(data: Message, transform: TransformStamped) -> Message:  # noqa: ARG001
    return data


@pytest.mark.parametrize("stamp", [2, LATEST])
@pytest.mark.parametrize(("max_age", "policy"), [(None, None), (0.5, POLICY)])
def test_data_are_looked_up_at_their_own_stamp(
    stamp: int | Latest, max_age: float | None, policy: Policy | None
) -> None:
    point = PointStamped("laser", stamp, (1.0, 0.0, 0.0))
    expected = Question("map", "laser", stamp, None, None, max_age, policy)
    assert question_of(point, "map", None, None, max_age, policy) == expected


@pytest.mark.parametrize(("at", "stamp"), [(5, 2), (LATEST, 2), (5, LATEST)])
@pytest.mark.parametrize(("max_age", "policy"), [(None, None), (0.5, POLICY)])
def test_data_at_another_stamp_are_looked_up_through_the_fixed_frame(
    at: int | Latest, stamp: int | Latest, max_age: float | None, policy: Policy | None
) -> None:
    point = PointStamped("laser", stamp, (1.0, 0.0, 0.0))
    expected = Question("base", "laser", at, source_at=stamp, fixed="map", max_age=max_age, policy=policy)
    assert question_of(point, "base", at, "map", max_age, policy) == expected


POINT = PointStamped("laser", 2, (1.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("data", "at", "fixed", "message"),
    [
        pytest.param(Smell(), None, None, "@do_transform.register(Smell)", id="unregistered type"),
        pytest.param(("map", 0), 5, None, "@do_transform.register(tuple)", id="no data at all"),
        pytest.param(
            LaserScan("laser", 2, np.array([4.0]), angle_min=0.0, angle_increment=0.0),
            None,
            None,
            "transform its to_points() instead",
            id="laser scan",
        ),
        pytest.param(
            Message(),
            None,
            None,
            "a Message has no frame and stamp of its own: look the transform up and call do_transform",
            id="no frame and stamp",
        ),
        pytest.param(Note(), None, None, "a Note has no frame and stamp of its own", id="no stamp"),
        pytest.param(POINT, 5, None, "at and fixed go together", id="at alone"),
        pytest.param(POINT, LATEST, None, "at and fixed go together", id="latest alone"),
        pytest.param(POINT, None, "map", "at and fixed go together", id="fixed alone"),
    ],
)
def test_wrong_arguments_are_a_type_error(data: Any, at: int | Latest | None, fixed: str | None, message: str) -> None:
    with pytest.raises(TypeError, match=re.escape(message)):
        question_of(data, "map", at, fixed, None, None)

""""""

import copy
import json
import math
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from support.strategies import samples

import tfbus
from tfbus import LATEST, Covariance, InvalidTransformError, Transform, TransformStamped, UncertainSample
from tfbus.geometry.stamped import (
    GREATEST_BOUND,
    answer_of,
    as_max_translation,
    is_within,
    not_physical,
    qualified_answer,
)
from tfbus.rows import IDENTITY
from tfbus.stamps import STAMP_MAX, STAMP_MIN

MOVE = Transform((1.0, 2.0, 3.0))


@pytest.mark.parametrize(
    ("parent", "child", "stamp", "reason", "text"),
    [
        ("", "base_link", 0, "frame name", "a frame name must not be empty"),
        ("//a/b", "base_link", 0, "frame name", "must not start with '/', got '//a/b': write 'a/b'"),
        ("map", "/", 0, "frame name", "must not start with '/', got '/'$"),
        ("map", "map", 0, "self transform", "frame 'map' cannot be its own parent"),
        ("map", "base_link", STAMP_MIN - 1, "stamp", "64-bit"),
        ("map", "base_link", STAMP_MAX + 1, "stamp", "64-bit"),
    ],
)
def test_an_invalid_sample_is_refused_with_its_facts(
    parent: str, child: str, stamp: int, reason: str, text: str
) -> None:
    with pytest.raises(InvalidTransformError, match=text) as caught:
        TransformStamped(parent, child, stamp, MOVE, "odometry")
    error = caught.value
    assert (error.reason, error.parent, error.child, error.authority) == (reason, parent, child, "odometry")


@pytest.mark.parametrize("stamp", [STAMP_MIN, 0, STAMP_MAX, np.int64(5)])
def test_a_stamp_is_kept_as_a_plain_int(stamp: int) -> None:
    sample = TransformStamped("map", "base_link", stamp, MOVE)
    assert type(sample.stamp) is int
    assert sample.stamp == stamp


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"stamp": 1.5}, "from_seconds"),
        ({"stamp": LATEST}, "int of nanoseconds"),
        ({"stamp": None}, "int of nanoseconds"),
        ({"stamp": True}, "int of nanoseconds"),
        ({"parent": b"map"}, "a frame name must be a str, not b'map'"),
        ({"child": None}, "a frame name must be a str, not None"),
        ({"transform": np.eye(4)}, "transform must be a Transform"),
        ({"transform": None}, "transform must be a Transform"),
        ({"authority": None}, "authority must be a str"),
    ],
)
def test_an_argument_of_the_wrong_type_is_a_type_error_that_shows_it(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(TypeError, match=text):
        TransformStamped(**{"parent": "map", "child": "base_link", "stamp": 0, "transform": MOVE, **changes})


@pytest.mark.parametrize("name", ["parent", "child", "stamp", "transform", "authority", "static", "colour"])
def test_a_sample_cannot_be_changed(name: str) -> None:
    sample = TransformStamped("map", "base_link", 7, MOVE)
    with pytest.raises(AttributeError):
        setattr(sample, name, "other")
    assert sample == TransformStamped("map", "base_link", 7, MOVE)


@pytest.mark.parametrize(
    ("name", "value"),
    {"parent": "odom", "child": "b", "stamp": 8, "transform": Transform(), "authority": "me", "static": True}.items(),
)
def test_a_changed_copy_differs_in_that_field_only(name: str, value: Any) -> None:
    sample = TransformStamped("map", "base_link", 7, MOVE, "odometry")
    changed = sample.replace(**{name: value})
    assert getattr(changed, name) == value
    assert changed != sample
    assert hash(changed) != hash(sample)
    assert changed.replace(**{name: getattr(sample, name)}) == sample


def test_replaced_fields_are_checked_again() -> None:
    sample = TransformStamped("map", "base_link", 7, MOVE, "odometry")
    with pytest.raises(InvalidTransformError, match="own parent"):
        sample.replace(parent="base_link")
    with pytest.raises(TypeError, match="from_seconds"):
        sample.replace(stamp=7.0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="colour"):
        sample.replace(colour="red")  # type: ignore[call-arg]


@given(samples())
def test_copies_pickles_and_the_repr_of_a_sample_are_equal_to_it(sample: TransformStamped) -> None:
    names = {"Transform": Transform, "TransformStamped": TransformStamped}
    assert eval(repr(sample), names) == sample
    for twin in (sample.replace(), pickle.loads(pickle.dumps(sample)), copy.copy(sample), copy.deepcopy(sample)):
        assert twin == sample
        assert hash(twin) == hash(sample)


def test_copies_pickles_and_the_repr_of_a_sample_have_its_error() -> None:
    error = Covariance.of(xyz=0.1, rpy=0.02)
    sample = UncertainSample("map", "base", 5, MOVE, "me", covariance=error, kind="drift")
    for twin in (pickle.loads(pickle.dumps(sample)), copy.copy(sample), copy.deepcopy(sample)):
        assert (type(twin), twin, twin.kind) == (UncertainSample, sample, "drift")
        assert twin.covariance.matrix == pytest.approx(error.matrix)
    assert (
        repr(sample)
        == f"UncertainSample('map', 'base', 5, {MOVE!r}, authority='me', covariance={error!r}, kind='drift')"
    )


def test_the_text_of_a_sample_has_frames_and_seconds() -> None:
    sample = TransformStamped("map", "base_link", 12_500_000_000, MOVE)
    assert str(sample).startswith("map <- base_link at 12.500 s: ")
    assert str(sample.replace(static=True)).startswith("map <- base_link static: ")


# Batches


@given(samples())
def test_a_sample_comes_back_from_json(sample: TransformStamped) -> None:
    data = json.loads(json.dumps(sample.to_dict()))
    assert data["type"] == "TransformStamped"
    assert type(data["stamp"]) is int
    assert TransformStamped.from_dict(data) == sample


def test_an_answer_with_a_policy_comes_back_with_its_use_of_the_policy() -> None:
    answer = qualified_answer("map", "base", 5, IDENTITY, False, 3, 4)
    data = json.loads(json.dumps(answer.to_dict()))
    back = TransformStamped.from_dict(data)
    assert back == answer
    assert (back.extrapolated_by, back.gap) == (3, 4)
    for wrong in ({"gap": None}, {"extrapolated_by": "3"}, {"more": 1}, {"stamp": 0.5}, {"parent": "/map"}):
        with pytest.raises(ValueError, match=r"gap|extrapolated_by|more|stamp|/map"):
            TransformStamped.from_dict({**data, **wrong})


@pytest.mark.parametrize(
    "answer", [answer_of("map", "map", 5, IDENTITY, True), qualified_answer("map", "map", 5, IDENTITY, False, 3, 4)]
)
def test_the_answer_of_a_frame_in_itself_comes_back_from_json(answer: TransformStamped) -> None:
    back = TransformStamped.from_dict(json.loads(json.dumps(answer.to_dict())))
    assert (type(back), back) == (type(answer), answer)
    assert (back.extrapolated_by, back.gap) == (answer.extrapolated_by, answer.gap)
    with pytest.raises(ValueError, match="/map"):
        TransformStamped.from_dict({**answer.to_dict(), "parent": "/map", "child": "/map"})


FAR_AWAY = Transform((1e308, 0.0, 0.0))


@pytest.mark.parametrize(
    "transform", [FAR_AWAY @ FAR_AWAY, FAR_AWAY.inverse() @ FAR_AWAY.inverse() @ FAR_AWAY @ FAR_AWAY]
)
def test_a_product_that_has_overflowed_is_not_finite(transform: Transform) -> None:
    sample = TransformStamped("a", "b", 0, transform)
    assert not is_within(sample, GREATEST_BOUND)
    assert not_physical(sample, GREATEST_BOUND).reason == "not finite"


def test_finite_numbers_whose_length_overflows_are_not_physical() -> None:
    sample = TransformStamped("a", "b", 0, Transform((1.7e308, 1.7e308, 0.0)))
    assert not_physical(sample, GREATEST_BOUND).reason == "not physical"


@pytest.mark.parametrize(
    ("bound", "error", "text"),
    [
        *((bound, ValueError, "greater than 0 and at most 1e\\+100 m") for bound in (0.0, -1.0, 1.1e100, math.nan)),
        *((bound, TypeError, "a number in m") for bound in (None, "far", True)),
    ],
)
def test_a_bound_of_translations_is_a_number_up_to_1e100(bound: Any, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=f"max_translation must be {text}"):
        as_max_translation(bound)


# Products and inverses


def test_transforms_whose_frames_meet_are_composed_and_keep_the_stamp_of_the_one_that_moves() -> None:
    turned = Transform.from_xyz_rpy((1.0, 2.0, 0.0), (0.0, 0.0, math.pi / 2))
    moving = TransformStamped("map", "base", 7, turned, "odometry")
    mounted = TransformStamped("base", "laser", 3, Transform((0.5, 0.0, 0.0)), static=True)
    product = moving @ mounted
    assert (product.parent, product.child, product.stamp, product.static) == ("map", "laser", 7, False)
    assert product.transform.apply((0.0, 0.0, 0.0)) == pytest.approx((1.0, 2.5, 0.0))
    back = ~product
    assert (back.parent, back.child, back.stamp) == ("laser", "map", 7)
    assert back == ~mounted @ moving.inverse()
    assert (moving @ ~moving).transform.is_close(Transform.identity())
    assert (mounted @ ~mounted).static


@pytest.mark.parametrize(
    ("parent", "stamp", "why"),
    [
        ("odom", 7, "the frames do not meet: 'map' <- 'base' @ 'odom' <- 'laser'"),
        ("base", 8, "'map' <- 'base' is at .* look both up at one stamp"),
    ],
)
def test_transforms_that_do_not_meet_in_frame_and_time_are_not_composed(parent: str, stamp: int, why: str) -> None:
    moving = TransformStamped("map", "base", 7, Transform())
    with pytest.raises(ValueError, match=why):
        moving @ TransformStamped(parent, "laser", stamp, Transform())
    with pytest.raises(TypeError):
        moving @ Transform()  # type: ignore[operator]


TODAY = 1_764_300_000_123_456_789


def test_a_browser_gives_a_stamp_back_exactly_if_it_came_as_text() -> None:
    sample = TransformStamped("map", "cart", TODAY, Transform((1.0, 2.0, 3.0)), "odometry")
    cloud = tfbus.PointCloud("map", TODAY, np.ones((1, 3)), np.array([TODAY - 1]))
    for data in (sample, cloud, tfbus.PointStamped("map", TODAY, (1.0, 2.0, 3.0))):
        # JavaScript reads every number as a float, and writes whole ones without a point.
        text = json.loads(json.dumps(data.to_dict(stamps="text")), parse_int=lambda digits: int(float(digits)))
        assert (text["stamp"], type(data).from_dict(text).stamp) == (str(TODAY), TODAY)
        with pytest.raises(ValueError, match="'int' or 'text'"):
            data.to_dict(stamps="float")  # type: ignore[arg-type]
    read = tfbus.PointCloud.from_dict(json.loads(json.dumps(cloud.to_dict(stamps="text"))))
    assert read.stamps is not None and read.stamps.tolist() == [TODAY - 1]
    for wrong in ("1.5", " 1", "1_0", "", "9" * 5000):
        with pytest.raises(ValueError, match="stamp"):
            TransformStamped.from_dict({**sample.to_dict(), "stamp": wrong})


def test_the_fields_of_a_sample_can_be_matched_and_replaced() -> None:
    sample = TransformStamped("map", "cart", 1, Transform((1.0, 2.0, 3.0)), "odometry")
    match sample:
        case TransformStamped("map", child, _, Transform((x, _, _), rotation), "odometry", False):
            assert (child, x, rotation) == ("cart", 1.0, (0.0, 0.0, 0.0, 1.0))
        case _:
            pytest.fail("no match")
    moved = sample.transform.__replace__(translation=(0.0, 0.0, 1.0))
    assert moved == Transform((0.0, 0.0, 1.0)) and sample.__replace__(transform=moved) == sample.replace(
        transform=moved
    )
    with pytest.raises(InvalidTransformError):
        sample.__replace__(child="map")


def test_pydantic_reads_and_writes_a_sample_as_its_dict_and_answers_too() -> None:
    pydantic = pytest.importorskip("pydantic")
    tree = tfbus.TransformTree()
    tree.insert_many([TransformStamped("map", "cart", TODAY + ns, Transform((ns, 0.0, 0.0)), "odo") for ns in (0, 10)])
    adapter = pydantic.TypeAdapter(TransformStamped)
    answers = [
        tree.lookup("map", "cart"),
        tree.lookup("map", "cart", TODAY + 5, max_gap=1.0),
        tree.lookup("map", "map"),
    ]
    for sample in answers:
        read = adapter.validate_json(adapter.dump_json(sample))
        assert read == adapter.validate_python(adapter.dump_python(sample)) == sample
        assert json.loads(adapter.dump_json(sample)) == sample.to_dict() == read.to_dict()
        assert adapter.validate_python(sample) is sample
        assert adapter.validate_python(sample.to_dict(stamps="text")) == sample
    short = {
        "parent": "map",
        "child": "cart",
        "stamp": 1,
        "transform": {"translation": [1, 2, 3], "rotation": [0, 0, 0, 1]},
    }
    assert adapter.validate_python(short) == TransformStamped("map", "cart", 1, Transform((1, 2, 3)))
    bad = {**short, "transform": {"translation": [1, 2, 3], "rotation": [0, 0, 0, 9]}}
    wrongs: list[Any] = [bad, {**short, "child": ""}, {**short, "more": 1}, {**short, "stamp": 1.5}, [], {}]
    for wrong in wrongs:
        with pytest.raises(pydantic.ValidationError):
            adapter.validate_python(wrong)
    poses, pose = pydantic.TypeAdapter(tfbus.PoseStamped), tfbus.PoseStamped("map", TODAY, Transform())
    assert poses.validate_json(poses.dump_json(pose)) == pose
    schema = adapter.json_schema(mode="serialization")
    assert schema == adapter.json_schema() and schema["required"] == ["parent", "child", "stamp", "transform"]
    assert schema["properties"]["stamp"]["type"] == "integer"
    assert schema["$defs"]["Transform"]["properties"]["rotation"]["minItems"] == 4

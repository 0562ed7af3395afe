import copy
import math
import pickle
import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import pr2

from tfbus import (
    InvalidRobotError,
    InvalidTransformError,
    Joint,
    LimitViolation,
    Mimic,
    RobotModel,
    Transform,
    TransformStamped,
)

UP = (0.0, 0.0, 1.0)


def fixed(name: str, parent: str, child: str) -> Joint:
    return Joint(name, "fixed", parent, child, Transform((0.0, 0.0, 1.0)))


def slide(name: str, parent: str, child: str, **more: Any) -> Joint:
    """One whose position is the child's x."""
    return Joint(name, "prismatic", parent, child, **more)


LEFT = Mimic("left", -1.0)
RIGHT = Mimic("right", 2.0, 0.5)


def gripper(*, follower: Mimic = LEFT, third: Mimic = RIGHT) -> RobotModel:
    """A hand with a fixed camera; the second finger follows the first, and a third the second."""
    return RobotModel(
        "gripper",
        ["hand", "camera", "third", "right", "left"],
        [
            slide("third", "hand", "third", mimic=third, upper=1.0),
            slide("right", "hand", "right", mimic=follower),
            fixed("mount", "hand", "camera"),
            slide("left", "hand", "left", lower=-0.5, upper=0.5),
        ],
    )


def xs(samples: list[TransformStamped]) -> dict[str, float]:
    return {sample.child: sample.transform.translation[0] for sample in samples if not sample.static}


# Samples


def test_fixed_joints_are_static_and_all_carry_stamp_authority_and_prefix() -> None:
    samples = gripper().transforms({"left": 0.25, "right": 0.5}, stamp=42, authority="me", prefix="r1/")
    assert {(sample.stamp, sample.authority, sample.parent) for sample in samples} == {(42, "me", "r1/hand")}
    assert {sample.child: sample.static for sample in samples} == {
        "r1/camera": True,
        "r1/third": False,
        "r1/right": False,
        "r1/left": False,
    }
    assert samples[0].transform == Transform((0.0, 0.0, 1.0))


def test_positions_of_fixed_and_of_unknown_joints_are_ignored() -> None:
    model = gripper()
    assert model.transforms({"mount": 9.0, "elbow": math.nan}, 0) == model.transforms({}, 0)
    assert model.unknown_joints({"mount": 9.0, "elbow": 0.0, "left": 0.0}) == ["elbow"]


# Mimicking


def test_a_chain_of_mimics_follows_its_leader() -> None:
    assert xs(gripper().transforms({"left": 0.25}, 0)) == {"left": 0.25, "right": -0.25, "third": 2.0 * -0.25 + 0.5}


def test_a_position_of_its_own_overrides_the_mimic_and_is_followed_by_others() -> None:
    """As in robot_state_publisher."""
    assert xs(gripper().transforms({"left": 0.25, "right": 1.0}, 0)) == {"left": 0.25, "right": 1.0, "third": 2.5}
    assert xs(gripper().transforms({"right": 1.0}, 0)) == {"right": 1.0, "third": 2.5}


def test_a_joint_may_mimic_a_fixed_joint_with_a_position() -> None:
    model = gripper(follower=Mimic("mount", 2.0))
    assert xs(model.transforms({"mount": 1.0}, 0)) == {"right": 2.0, "third": 4.5}
    assert xs(model.transforms({"left": 1.0}, 0)) == {"left": 1.0}


def test_a_thousand_joints_may_mimic_each_other_in_a_chain() -> None:
    links = ["root", *(f"l{i}" for i in range(1_000))]
    joints = [slide(f"j{i}", "root", f"l{i}", mimic=Mimic(f"j{i + 1}") if i < 999 else None) for i in range(1_000)]
    assert set(xs(RobotModel("r", links, joints).transforms({"j999": 0.5}, 0)).values()) == {0.5}


# Zero and limits


def test_zeros_put_every_joint_at_its_origin() -> None:
    joints = [
        Joint("turn", "continuous", "a", "b"),
        Joint("plane", "planar", "a", "c", axis=UP),
        Joint("free", "floating", "a", "d", Transform((1.0, 2.0, 3.0))),
        slide("slide", "a", "e"),
        slide("shadow", "a", "f", mimic=Mimic("slide")),
        fixed("mount", "a", "g"),
    ]
    model = RobotModel("r", "abcdefg", joints)
    assert model.zeros() == {"turn": 0.0, "plane": (0.0, 0.0, 0.0), "free": Transform(), "slide": 0.0}
    samples = model.transforms(model.zeros(), 0)
    assert {sample.child for sample in samples} == set("bcdefg")
    assert all(
        sample.transform == joint.origin for sample in samples for joint in joints if joint.child == sample.child
    )


@pytest.mark.parametrize(("position", "beyond"), [(-0.6, True), (-0.5, False), (0.0, False), (0.5, False), (0.6, True)])
def test_a_position_outside_of_the_limits_is_reported_and_not_changed(position: float, beyond: bool) -> None:
    model = gripper(third=Mimic("right", 0.0))
    assert model.violations({"left": position}) == ([LimitViolation("left", position, -0.5, 0.5)] if beyond else [])
    assert xs(model.transforms({"left": position}, 0))["left"] == position


def test_a_mimicking_joint_has_limits_too_of_which_one_may_be_missing() -> None:
    [violation] = gripper().violations({"left": -0.4})
    assert violation == LimitViolation("third", 1.3, None, 1.0)
    assert str(violation) == "joint 'third': position 1.3 is outside its limits, to 1"
    lower = LimitViolation("j", -2.5, -2.0, math.inf)
    assert str(lower) == "joint 'j': position -2.5 is outside its limits, from -2 to inf"


# Refusals


@pytest.mark.parametrize("call", ["transforms", "moving_transforms"])
@pytest.mark.parametrize(
    ("positions", "joint"),
    [
        ({"left": math.nan}, "left"),
        ({"right": math.inf, "left": 0.0}, "right"),
        ({"right": 1e308}, "third"),
    ],
)
def test_a_position_that_is_not_finite_is_refused_with_the_name_of_the_joint(
    call: str, positions: dict[str, float], joint: str
) -> None:
    with pytest.raises(InvalidTransformError, match=f"^joint '{joint}': position .* is not finite") as caught:
        getattr(gripper(), call)(positions, 0)
    assert (caught.value.reason, caught.value.parent, caught.value.child) == ("not finite", "hand", joint)


def test_a_bad_stamp_or_prefix_is_refused() -> None:
    with pytest.raises(InvalidTransformError, match="must not start with '/'"):
        gripper().transforms({"left": 0.0}, 0, prefix="/r1/")
    with pytest.raises(TypeError, match="from_seconds"):
        gripper().transforms({"left": 0.0}, 1.5)  # type: ignore[arg-type]


SEVERAL = [fixed("1", "a", "b"), fixed("2", "c", "d")]


@pytest.mark.parametrize(
    ("links", "joints", "message"),
    [
        ("", [], 'in <robot name="r">: it has no links'),
        (["a", "/b"], [], "in <link name=\"/b\">: a frame name must not be empty or start with '/'"),
        (["a", ""], [], "in <link name=\"\">: a frame name must not be empty or start with '/'"),
        ("aa", [], 'in <link name="a">: there are 2 of this name'),
        ("abc", [fixed("1", "a", "b"), fixed("1", "a", "c")], "1: there are 2 of this name"),
        ("ab", [fixed("1", "x", "b")], "1: parent link 'x' is not there"),
        ("ab", [fixed("1", "a", "y")], "1: child link 'y' is not there"),
        ("abc", [fixed("1", "a", "c"), fixed("2", "b", "c")], "2: link 'c' has two parents: 'a' by joint '1', and 'b'"),
        ("ab", [], "in <robot name=\"r\">: it has several roots: 'a', 'b'"),
        ("abcd", SEVERAL, "in <robot name=\"r\">: it has several roots: 'a', 'c'"),
        ("a", [fixed("1", "a", "a")], "1: the links 'a' -> 'a' form a loop"),
        (
            "abc",
            [fixed("1", "a", "b"), fixed("2", "b", "c"), fixed("3", "c", "a")],
            "3: the links 'a' -> 'c' -> 'b' -> 'a' form a loop",
        ),
        (
            "abcd",
            [fixed("1", "c", "b"), fixed("2", "d", "c"), fixed("3", "c", "d")],
            "2: the links 'c' -> 'd' -> 'c' form a loop",
        ),
        ("ab", [slide("1", "a", "b", mimic=Mimic("9"))], "1: it mimics '9', which is not there"),
        ("ab", [slide("1", "a", "b", mimic=Mimic("1"))], "1: the joints '1' -> '1' mimic each other"),
        (
            "abcd",
            [slide(name, "a", child, mimic=Mimic(leader)) for name, child, leader in ("1b2", "2c3", "3d2")],
            "2: the joints '2' -> '3' -> '2' mimic each other",
        ),
        (
            "abc",
            [Joint("1", "floating", "a", "b"), slide("2", "a", "c", mimic=Mimic("1"))],
            "2: it mimics '1', but '1' is floating: only one number can be mimicked",
        ),
        (
            "abc",
            [Joint("1", "planar", "a", "b", mimic=Mimic("2")), slide("2", "a", "c")],
            "1: it mimics '2', but '1' is planar: only one number can be mimicked",
        ),
    ],
)
def test_an_invalid_robot_is_refused_with_the_element(links: Any, joints: list[Joint], message: str) -> None:
    with pytest.raises(InvalidRobotError) as caught:
        RobotModel("r", links, joints)
    assert str(caught.value) == re.sub(r"^([0-9]): ", r'in <joint name="\1">: ', message)


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=2, max_size=4))
def test_only_links_that_form_one_tree_are_a_robot(edges: list[tuple[int, int]]) -> None:
    """Against the obvious rule: one link reaches every other in exactly one way."""
    links = [f"l{i}" for i in range(4)]
    joints = [fixed(f"{i}: {a} {b}", f"l{a}", f"l{b}") for i, (a, b) in enumerate(edges)]
    children = [child for _, child in edges]
    reached = {a for a in range(4) if a not in children}
    for _ in range(4):
        reached |= {child for parent, child in edges if parent in reached}
    is_tree = len(children) == len(set(children)) == 3 and len(reached) == 4
    try:
        model = RobotModel("r", links, joints)
    except InvalidRobotError:
        assert not is_tree
    else:
        assert is_tree
        assert int(model.root[1:]) not in children


def test_a_tree_of_any_depth_is_a_robot() -> None:
    joints = [fixed(f"{i}", f"l{i + 1}", f"l{i}") for i in range(5_000)]
    assert RobotModel("deep", [f"l{i}" for i in range(5_001)], joints).root == "l5000"


def test_a_model_is_a_value() -> None:
    model = gripper()
    for twin in (copy.deepcopy(model), pickle.loads(pickle.dumps(model)), gripper()):
        assert (twin, hash(twin)) == (model, hash(model))
        assert twin.transforms({"left": 0.1}, 0) == model.transforms({"left": 0.1}, 0)
    assert gripper(follower=Mimic("left")) != model


# From URDF


def test_a_model_comes_from_the_text_of_a_urdf() -> None:
    model = RobotModel.from_urdf(
        '<robot name="crane"><link name="base"/><link name="hook"/><joint name="rope" type="prismatic"><origin'
        ' xyz="2 0 5"/><axis xyz="0 0 -1"/><parent link="base"/><child link="hook"/></joint></robot>'
    )
    assert (model.name, model.root, model.links) == ("crane", "base", ("base", "hook"))
    [sample] = model.transforms({"rope": 1.5}, stamp=7)
    assert sample == TransformStamped("base", "hook", 7, Transform((2.0, 0.0, 3.5)))


# The real thing


def assert_equal_to_1e_9(ours: list[TransformStamped], recorded: dict[tuple[str, str], Transform]) -> None:
    assert {(sample.parent, sample.child) for sample in ours} == recorded.keys()
    for sample in ours:
        theirs = recorded[sample.parent, sample.child]
        turned = sample.transform.rotation
        assert math.dist(sample.transform.translation, theirs.translation) <= 1e-9, sample
        flipped = [-part for part in turned]
        assert min(math.dist(turned, theirs.rotation), math.dist(flipped, theirs.rotation)) <= 1e-9, sample


@pr2.needed
@pytest.mark.parametrize("mimicking", ["as recorded", "derived"])
def test_the_moving_joints_of_a_pr2_are_where_the_real_robot_state_publisher_put_them(mimicking: str) -> None:
    model = RobotModel.from_urdf(pr2.URDF)
    followers = {joint.name for joint in model.joints if joint.mimic is not None}
    recorded = pr2.recorded()
    states = {state.stamp: state for state in recorded.states}
    assert (len(recorded.moving), len(followers)) == (153, 6)
    for stamp, theirs in recorded.moving.items():
        positions = dict(zip(states[stamp].names, states[stamp].positions, strict=True))
        if mimicking == "derived":
            positions = {name: position for name, position in positions.items() if name not in followers}
        ours = model.moving_transforms(positions, stamp)
        assert {sample.stamp for sample in ours} == {stamp}
        assert_equal_to_1e_9(ours, theirs)


@pr2.needed
def test_the_fixed_joints_of_a_pr2_are_where_the_real_robot_state_publisher_put_them(
    capfd: pytest.CaptureFixture[str],
) -> None:
    model = RobotModel.from_urdf(pr2.URDF)
    assert (model.name, model.root, len(model.links), len(model.joints)) == ("pr2", "base_footprint", 83, 82)
    assert_equal_to_1e_9(model.fixed_transforms(0), pr2.recorded().static)
    assert capfd.readouterr() == ("", "")


def test_the_repr_is_one_line_with_links_and_moving_joints() -> None:
    joints = (slide("rail", "base", "hand"), fixed("glue", "hand", "led"), slide("gripper", "hand", "finger"))
    model = RobotModel("arm", ("base", "hand", "led", "finger"), joints)
    assert repr(model) == "<RobotModel 'arm': 4 links below 'base', 2 moving joints>"

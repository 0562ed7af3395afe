"""Frame names, and the prefixes of several robots on one bus."""

from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.strategies import frame_names

from tfbus import InvalidTransformError
from tfbus.frames import Prefix, as_prefix, check_frame, is_frame

names = st.text("ab/_", min_size=1, max_size=6).filter(lambda name: not name.startswith("/"))


@given(frame_names())
def test_any_text_without_a_leading_slash_is_a_frame_name(name: str) -> None:
    assert is_frame(name)
    check_frame(name)


@pytest.mark.parametrize(
    ("bad", "text"),
    [
        ("", "a frame name must not be empty"),
        ("/map", "a frame name must not start with '/', got '/map': write 'map'"),
        ("//a/b", "a frame name must not start with '/', got '//a/b': write 'a/b'"),
        ("/", "a frame name must not start with '/', got '/'"),
    ],
)
def test_a_bad_frame_name_is_refused_with_the_facts(bad: str, text: str) -> None:
    assert not is_frame(bad)
    with pytest.raises(InvalidTransformError) as caught:
        check_frame(bad, "map", "base_link", "odometry")
    error = caught.value
    assert (str(error), error.reason) == (text, "frame name")
    assert (error.parent, error.child, error.authority) == ("map", "base_link", "odometry")


@pytest.mark.parametrize("bad", [None, 5, b"map"])
def test_a_frame_name_that_is_no_str_is_a_type_error_that_shows_it(bad: Any) -> None:
    with pytest.raises(TypeError, match=f"a frame name must be a str, not {bad!r}"):
        is_frame(bad)


# Prefixes


def test_a_name_gets_the_prefix_as_it_is_unless_it_is_shared() -> None:
    prefix = Prefix("robot1/", {"map", "earth"})
    assert [prefix.on_bus(name) for name in ("base", "map", "earth", "robot2/base")] == [
        "robot1/base",
        "map",
        "earth",
        "robot1/robot2/base",
    ]
    assert Prefix("r1_").on_bus("base") == "r1_base"


@given(names, st.sets(names, max_size=3), names)
def test_a_local_name_survives_the_way_to_the_bus_and_back(text: str, shared: set[str], name: str) -> None:
    assume(not any(other.startswith(text) for other in shared))
    prefix = Prefix(text, shared)
    assert prefix.local(prefix.on_bus(name)) == name


def test_a_frame_of_another_robot_is_never_a_shared_or_local_one() -> None:
    prefix = Prefix("robot1/", {"map"})
    assert [prefix.local(name) for name in ("map", "robot1/map", "robot1/", "robot1//a", "robot2/a")] == [
        "map",
        "/robot1/map",
        "/robot1/",
        "/robot1//a",
        "/robot2/a",
    ]


@given(names, st.sets(names, max_size=3), names)
def test_a_frame_without_a_local_name_gets_a_leading_slash(text: str, shared: set[str], name: str) -> None:
    assume(not any(other.startswith(text) for other in shared))
    prefix = Prefix(text, shared)
    local = prefix.local(name)
    assert local == f"/{name}" if local.startswith("/") else prefix.on_bus(local) == name


@pytest.mark.parametrize("name", ["", "/base", "//"])
def test_an_invalid_name_gets_no_prefix(name: str) -> None:
    assert Prefix("robot1/").on_bus(name) == name


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
    ],
)
def test_a_bad_prefix_is_refused(prefix: Any, shared: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        Prefix(prefix, shared)


@pytest.mark.parametrize("shared", [{"map"}, "map", "", ["map", "earth"], iter(["map"]), 5])
def test_shared_names_without_a_prefix_are_refused(shared: Any) -> None:
    with pytest.raises(TypeError):
        as_prefix(None, shared)


@pytest.mark.parametrize("shared", [(), set(), iter([])])
def test_without_prefix_and_shared_names_there_is_no_prefix(shared: Any) -> None:
    assert as_prefix(None, shared) is None


def test_a_prefix_with_shared_names_is_a_prefix() -> None:
    prefix = as_prefix("robot1/", ["map"])
    assert prefix is not None
    assert (prefix.prefix, prefix.shared) == ("robot1/", frozenset({"map"}))

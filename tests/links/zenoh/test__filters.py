import json
from base64 import urlsafe_b64encode

import pytest
import zenoh

from tfbus.links.zenoh._filters import LONGEST_FILTER, MOST_FILTERS, Filters, name_of, read_filter, write_filter

FRAMES = ["base_link", "arm/hand", "rad ä*$#?", 'with "quotes"', "\udc80"]


def encoded(text: str) -> str:
    return urlsafe_b64encode(text.encode()).decode()


def test_a_filter_is_one_part_of_a_key_and_tells_robots_and_frames() -> None:
    chunk = write_filter(["r$*", "x1"], FRAMES)
    assert str(zenoh.KeyExpr(f"a/{chunk}/b")).count("/") == 2
    assert not set(chunk) & set("*$#?/@")
    robots, frames = read_filter(chunk)
    assert ([str(robot) for robot in robots], frames) == (["r$*", "x1"], frozenset(FRAMES))
    assert write_filter(["x1", "r$*"], FRAMES[::-1]) == chunk, "the order is none of it"
    assert len(name_of(chunk)) == 32
    assert name_of(chunk) != name_of(write_filter(["r$*"], FRAMES))


def test_a_filter_that_is_too_long_for_a_key_is_none() -> None:
    names = [f"frame {number:013}" for number in range(1_000)]
    assert write_filter(["*"], names) == ""
    assert 0 < len(write_filter(["*"], names[:500])) <= LONGEST_FILTER
    # Four characters hold three bytes, and a filter of one empty name has some.
    length = LONGEST_FILTER * 3 // 4 - len(json.dumps([["*"], [""]], separators=(",", ":")))
    longest = write_filter(["*"], ["x" * length])
    assert (len(longest), read_filter(longest)[1]) == (LONGEST_FILTER, frozenset(["x" * length]))
    assert write_filter(["*"], ["x" * (length + 1)]) == ""
    with pytest.raises(ValueError, match=f"more than {LONGEST_FILTER}"):
        read_filter(encoded(json.dumps([["*"], ["x" * (length + 1)]], separators=(",", ":"))))


@pytest.mark.parametrize(
    "chunk",
    [
        "", "a", "ä", encoded("5"), encoded("[]"), encoded("[[],[],[]]"), encoded("[[],5]"), encoded('[[],[5]]'),
        encoded("[5,[]]"), encoded("[[5],[]]"), encoded('[["a//b"],[]]'), encoded('[["*"],"base"]'), encoded("{}"),
        encoded('{"a":1,"b":2}'), encoded("[" * 9_000), encoded('[["*"],{"base":1}]'), encoded("\x00"),
        encoded(json.dumps([["*"], ["a" * LONGEST_FILTER]])),
    ],
)  # fmt: skip
def test_garbage_is_refused_and_whoever_tells_it_hears_all(chunk: str) -> None:
    filters = Filters("r1")
    with pytest.raises(ValueError, match="filter"):
        filters.joined(("a", None, "0"), chunk)
    filters.joined(("b", None, "0"), chunk)
    assert (filters.wanted, filters.are_served, filters.cover(["a"])) == ({}, False, False)
    filters.left(("a", None, "0"), chunk)
    assert not filters.are_served
    filters.left(("b", None, "0"), chunk)
    assert filters.are_served


@pytest.mark.parametrize(
    ("robots", "robot", "wants"),
    [(["*"], "~", True), (["*"], "r1", True), (["r$*"], "r1", True), (["r$*"], "x", False), (["r1", "x"], "x", True),
     (["r$*"], "~", False), ([], "r1", False)],
)  # fmt: skip
def test_a_filter_wants_frames_of_its_robots_only(robots: list[str], robot: str, wants: bool) -> None:
    filters, chunk = Filters(robot), write_filter(robots, FRAMES)
    filters.joined(("a", None, "0"), chunk)
    assert filters.wanted == ({name_of(chunk): frozenset(FRAMES)} if wants else {})
    assert filters.cover(["a"]), "it hears nothing else in any case"


def test_a_filter_is_wanted_until_its_last_token_has_gone() -> None:
    filters, chunk, session = Filters("r1"), write_filter(["*"], FRAMES), object()
    tokens = [("a", None, "0"), ("a", session, "0"), ("b", session, "0"), ("c", None, "0")]
    for token in [*tokens, tokens[0]]:
        filters.joined(token, chunk)
    first = filters.wanted
    assert list(first) == [name_of(chunk)]
    assert filters.cover("abc")
    assert not filters.cover("abx")
    filters.left(("d", None, "0"), chunk)
    filters.left(("a", None, "0"), "another")
    filters.lose(session)
    assert filters.cover("ac")
    assert not filters.cover("b")
    filters.left(tokens[0], chunk)
    filters.left(tokens[0], chunk)
    assert not filters.cover("a")
    assert filters.wanted is first, "nothing has changed"
    filters.left(tokens[3], chunk)
    assert filters.wanted == {}
    filters.joined(tokens[3], chunk)
    assert filters.wanted == first


def test_too_many_filters_are_refused_until_some_have_gone() -> None:
    filters = Filters("r1")
    chunks = [write_filter(["*"], [f"frame{number}"]) for number in range(MOST_FILTERS + 1)]
    for number, chunk in enumerate(chunks[:-1]):
        filters.joined((f"{number}", None, "0"), chunk)
    assert filters.are_served
    with pytest.raises(ValueError, match="more than 100"):
        filters.joined(("last", None, "0"), chunks[-1])
    assert (len(filters.wanted), filters.are_served, filters.cover(["0"])) == (MOST_FILTERS, False, False)
    filters.left(("last", None, "0"), chunks[-1])
    filters.left(("5", None, "0"), chunks[5])
    assert filters.are_served
    filters.joined(("last", None, "0"), chunks[-1])
    assert name_of(chunks[-1]) in filters.wanted

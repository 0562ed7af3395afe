from itertools import pairwise

import pytest
import zenoh

from tfbus.links.zenoh._filters import name_of, write_filter
from tfbus.links.zenoh._keys import (
    ANY_ROBOT,
    FIRST_SESSION,
    LONGEST_NAME,
    NO_ROBOT,
    Keys,
    check_domain,
    check_robot,
    new_id,
    robots_expression,
)

A, B = "a" * 32, "b" * 32


def hears(one: Keys, other: Keys, kind: str) -> bool:
    """Whether what one link sends under a kind of key is what another has subscribed to."""
    own = zenoh.KeyExpr(one.token("0") if kind == "@alive" else one.own(kind))
    return any(own.intersects(zenoh.KeyExpr(key)) for key in other.heard(kind))


@pytest.mark.parametrize("kind", ["live", "@alive"])
def test_links_of_one_domain_hear_each_other_and_no_other_domain(kind: str) -> None:
    plain, robot = Keys("yard", A), Keys("yard", B, "r1")
    assert hears(plain, robot, kind)
    assert hears(robot, plain, kind)
    for domain in ("yard/r1", "yard/live", "yard/~", "yar", "r1"):
        for mine in (plain, robot):
            for robots in (("*",), ("r$*",)):
                other = Keys(domain, B, "r1", robots)
                assert not hears(mine, other, kind)
                assert not hears(other, mine, kind)


@pytest.mark.parametrize(
    ("pattern", "robots", "others"),
    [
        ("r1", ["r1"], ["r12", "x1", NO_ROBOT]),
        ("r*", ["r", "r1", "r12"], ["x1", NO_ROBOT]),
        ("*1", ["1", "r1"], ["r12"]),
        ("r*-*", ["r-", "r1-2"], ["r1"]),
        ("*", ["r1", NO_ROBOT], []),
        ("**", ["r1", NO_ROBOT], []),
    ],
)
def test_a_link_hears_the_robots_of_its_patterns(pattern: str, robots: list[str], others: list[str]) -> None:
    mine = Keys("yard", A, robots=(robots_expression(pattern),))
    assert [hears(Keys("yard", B, robot), mine, "live") for robot in robots] == [True] * len(robots)
    assert [hears(Keys("yard", B, robot), mine, "live") for robot in others] == [False] * len(others)


def test_of_slow_robots_a_link_hears_the_presence_and_the_slow_key_at_a_rate() -> None:
    mine = Keys("yard", A, robots=("r1", "s1"), slow_robots=(("s1", 2.0), ("s2", 0.5)))
    others = [Keys("yard", B, robot) for robot in ("r1", "s1", "s2", "x1")]
    assert [hears(other, mine, "live") for other in others] == [True, True, False, False]
    assert [hears(other, mine, "@alive") for other in others] == [True, True, True, False]
    assert len(mine.heard("@alive")) == 3, "each is heard once"
    rates = [
        [rate for key, rate in mine.slow() if zenoh.KeyExpr(key).intersects(zenoh.KeyExpr(other.own("slow")))]
        for other in others
    ]
    assert rates == [[], [2.0], [0.5], []]


@pytest.mark.parametrize("robot", [NO_ROBOT, "r1", "r-1.x_"])
def test_the_sender_is_in_a_key(robot: str) -> None:
    keys, other = Keys("yard/arm", A), Keys("yard/arm", B, robot)
    assert keys.sender(other.own("live"), "live") == B
    assert [keys.session(other.token(name)) for name in ("0", A, "x", "")] == [(B, "0"), (B, A), None, None]
    assert keys.session(other.own("@alive")) is None
    assert keys.sender(other.own("state"), "live") is None
    assert keys.of("state", B, robot) == other.own("state")
    assert zenoh.KeyExpr(keys.of("state", B, ANY_ROBOT)).includes(zenoh.KeyExpr(other.own("state")))


def test_of_a_token_the_robot_is_told_and_the_link_if_it_is_meant_to_be_heard() -> None:
    keys = Keys("yard/arm", A, robots=("r$*",), slow_robots=(("s1", 2.0),))
    for robot, heard in ((NO_ROBOT, None), ("r1", B), ("s1", B), ("x1", None)):
        token = Keys("yard/arm", B, robot).token(FIRST_SESSION)
        assert keys.robot_of(token) == robot
        assert keys.heard_link(token.encode()) == heard
    for token in (Keys("yard", B, "r1").token(FIRST_SESSION), Keys("yard/arm", B, "r1").token("x"), "", "\xff"):
        assert keys.heard_link(token.encode("latin-1")) is None


def test_a_new_id_is_that_of_a_link_or_of_a_session_and_never_the_same() -> None:
    ids = [new_id() for _ in range(100)]
    assert len(set(ids)) == len(ids)
    for link, session in pairwise(ids):
        assert Keys("yard", A).session(Keys("yard", link).token(session)) == (link, session)


@pytest.mark.parametrize(
    "key",
    ["**", "tfbus/yard/**", "tfbus/yard/*/live/" + A, "tfbus/yard/r1/live/*", "tfbus/yard/r1/live/robot",
     "tfbus/yard/r1/live/" + A + "0", "tfbus/yard/r1/live/" + A + "/more", "tfbus/other/r1/live/" + A,
     "tfbus/yard/$*/live/" + A, "live/" + A],
)  # fmt: skip
def test_a_key_that_names_no_link_has_no_sender(key: str) -> None:
    assert Keys("yard", B).sender(key, "live") is None


@pytest.mark.parametrize("domain", ["", "a b", "a//b", "/a", "a/", "a/*", "@a", "$a", "~", "ä", "x" * 201])
def test_a_domain_that_can_be_no_part_of_a_key_is_named(domain: str) -> None:
    with pytest.raises(ValueError, match="domain"):
        check_domain(domain)


def test_domains_and_robots_have_letters_digits_and_some_signs() -> None:
    assert check_domain("yard-1/arm_2.x") == "yard-1/arm_2.x"
    assert check_robot("r-1_2.x") == "r-1_2.x"
    longest = "x" * LONGEST_NAME
    assert {check(longest) for check in (check_domain, check_robot, robots_expression)} == {longest}
    for check in (check_domain, check_robot, robots_expression):
        with pytest.raises(ValueError, match=r"domain|robot"):
            check(longest + "x")


@pytest.mark.parametrize("robot", ["", "a/b", "*", "~", "a b", "@r", "x" * 201])
def test_a_robot_that_can_be_no_part_of_a_key_is_named(robot: str) -> None:
    with pytest.raises(ValueError, match="robot"):
        check_robot(robot)
    if robot != "*":
        with pytest.raises(ValueError, match="robot"):
            robots_expression(robot)


def test_a_link_with_a_filter_hears_its_parts_of_the_robots_that_it_hears_and_tells_the_filter_by_a_token() -> None:
    chunk = write_filter(["r$*"], ["base"])
    mine, robot, other = Keys("yard", A, robots=("r$*",), filter=chunk), Keys("yard", B, "r1"), Keys("yard", B, "x1")
    (heard,) = map(zenoh.KeyExpr, mine.heard("live"))
    part = robot.part(name_of(chunk))
    assert heard.intersects(zenoh.KeyExpr(part))
    assert robot.sender(part.rpartition("/")[0], "only") == B
    for key in (robot.own("live"), robot.part(name_of("another")), other.part(name_of(chunk))):
        assert not heard.intersects(zenoh.KeyExpr(key))
    for session in ("0", "c" * 32):
        token = mine.filter_token(session)
        assert zenoh.KeyExpr(robot.filter_tokens()).includes(zenoh.KeyExpr(token))
        assert not zenoh.KeyExpr(Keys("yard/r1", B).filter_tokens()).intersects(zenoh.KeyExpr(token))
        assert robot.filter_of(token) == (A, session, chunk)
    token = mine.filter_token("0")
    for key in (f"{token}/0", token.replace(A, "a"), token.replace("/0/", "/1/"), f"{token}{{}}", mine.token("0")):
        assert robot.filter_of(key) is None

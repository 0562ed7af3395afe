from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tfbus.links._receive_queue import Presence, Received
from tfbus.links.zenoh._keys import ANY_ROBOT, FIRST_SESSION, NO_ROBOT
from tfbus.links.zenoh._present import DIRECT, Present, Way

PATCH: Any = object()
OTHER: Any = object()
WAYS: list[Way] = [DIRECT, (None, "x"), (PATCH, FIRST_SESSION), (PATCH, "x"), (OTHER, FIRST_SESSION)]


class Scene:
    def __init__(self) -> None:
        self.received: list[tuple[str, Any]] = []
        self.changes: list[tuple[str, Presence]] = []
        self.present = Present(self._receive, lambda *change: self.changes.append(change))

    def _receive(self, item: Received) -> None:
        self.received.append((item.sender, item.content))


@given(st.lists(st.tuples(st.sampled_from("ab"), st.sampled_from(WAYS), st.sampled_from(Presence))))
def test_a_peer_comes_by_its_first_way_and_goes_by_its_last(notes: list[tuple[str, Way, Presence]]) -> None:
    scene, ways = Scene(), {"a": set[Way](), "b": set[Way]()}
    received, changes = list[tuple[str, Any]](), list[tuple[str, Presence]]()
    for peer, way, presence in notes:
        before = bool(ways[peer])
        (ways[peer].add if presence is Presence.JOINED else ways[peer].discard)(way)
        scene.present.note(peer, way, presence)
        if bool(ways[peer]) is not before:
            received.append((peer, presence))
        if bool(ways[peer]) is not before or way == DIRECT:
            changes.append((peer, presence))
        assert dict(scene.present) == {peer: known for peer, known in ways.items() if known}
        assert scene.present.is_direct(peer) is (DIRECT in ways[peer])
        assert scene.present.names(peer) == sorted({name for _, name in ways[peer]})
        assert scene.present.robots() == dict.fromkeys(scene.present, NO_ROBOT)
        assert len(scene.present) == len(list(scene.present)) == len(scene.present.keys())
    assert (scene.received, scene.changes) == (received, changes)


def test_the_end_of_a_patch_ends_what_it_reaches_of_one_peer() -> None:
    scene = Scene()
    for peer in ("a", "b"):
        for way in WAYS:
            scene.present.note(peer, way, Presence.JOINED, f"robot of {peer}")
    scene.present.end("a", PATCH)
    assert scene.present["a"] == {DIRECT, (None, "x"), (OTHER, FIRST_SESSION)}
    assert scene.present["b"] == set(WAYS)
    assert scene.present.robots() == {"a": "robot of a", "b": "robot of b"}
    assert [scene.present.robot(peer) for peer in ("a", "b")] == ["robot of a", "robot of b"]
    scene.present.end("nobody", PATCH)
    assert set(scene.present) == {"a", "b"}


def test_the_robot_of_a_peer_is_not_sure_if_somebody_has_announced_the_peer_with_another() -> None:
    scene = Scene()
    for way, robot in ((DIRECT, "r1"), ((PATCH, "x"), "r1")):
        scene.present.note("a", way, Presence.JOINED, robot)
        assert scene.present.robot("a") == "r1"
    scene.present.note("a", (None, "x"), Presence.JOINED, "r2")
    assert scene.present.robot("a") == ANY_ROBOT
    assert scene.present.robots() == {"a": "r1"}
    for way in WAYS:
        scene.present.note("a", way, Presence.LEFT, "r1")
    assert scene.present.robot("a") == ANY_ROBOT
    scene.present.note("a", DIRECT, Presence.JOINED, "r2")
    assert scene.present.robot("a") == "r2"


def test_whoever_is_not_there_has_no_ways() -> None:
    present = Scene().present
    assert ("a" in present, present.is_direct("a"), present.names("a"), bool(present)) == (False, False, [], False)
    with pytest.raises(KeyError):
        present["a"]


def test_peers_may_come_while_somebody_looks_at_them() -> None:
    scene = Scene()
    for peer in ("a", "b"):
        scene.present.note(peer, DIRECT, Presence.JOINED)
    for peer in scene.present:
        scene.present.note(f"{peer}{peer}", DIRECT, Presence.JOINED)
    assert set(scene.present) == {"a", "b", "aa", "bb"}

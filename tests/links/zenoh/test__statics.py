from collections.abc import Iterator
from queue import Queue

import pytest
import zenoh
from support.processes import PATIENCE, free_ports, new_domain

from tfbus.links._message import Message
from tfbus.links.zenoh._settings import settings
from tfbus.links.zenoh._statics import StaticKeys, subscribe_statics

KEPT, TOMBSTONE = Message(b"kept", b"1", 1), Message(b"gone", b"2", 0)


class Scene:
    """The static keys of one session, and what other sessions hear of them."""

    def __init__(self) -> None:
        self.prefix = f"tfbus/{new_domain()}/static"
        self.address = f"tcp/127.0.0.1:{free_ports(1)[0]}"
        self.sessions = [zenoh.open(settings(self.address, None, None, 2.0))]
        self.keys = StaticKeys(self.sessions[0], f"{self.prefix}/link")

    def hear(self) -> Queue[tuple[str, bytes]]:
        """Key and payload of all that a session which joins now receives."""
        heard: Queue[tuple[str, bytes]] = Queue()
        session = zenoh.open(settings([], self.address, None, 2.0))
        self.sessions.append(session)

        def note(sample: zenoh.Sample) -> None:
            heard.put((str(sample.key_expr).removeprefix(f"{self.prefix}/link/"), sample.payload.to_bytes()))

        self.subscriber = subscribe_statics(session, f"{self.prefix}/*/*", note)
        return heard


@pytest.fixture
def scene() -> Iterator[Scene]:
    made = Scene()
    yield made
    for session in made.sessions:
        session.close()


def test_the_last_message_of_each_frame_is_kept_for_late_joiners_under_its_quoted_name(scene: Scene) -> None:
    old = Message(b"old", b"", 1)
    assert scene.keys.publish({"arm/tool 0": old, "b": old}) == []
    assert scene.keys.publish({"arm/tool 0": KEPT, "b": None}) == []
    assert scene.hear().get(timeout=PATIENCE) == ("arm%2Ftool%200", b"kept")


def test_a_tombstone_is_kept_until_it_is_dropped(scene: Scene) -> None:
    assert scene.keys.publish({"a": KEPT, "b": KEPT}) == []
    assert not scene.keys.has_tombstones
    assert scene.keys.publish({"a": TOMBSTONE}) == []
    assert scene.keys.has_tombstones
    heard = scene.hear()
    assert {heard.get(timeout=PATIENCE) for _ in range(2)} == {("a", b"gone"), ("b", b"kept")}
    scene.keys.drop_tombstones()
    assert not scene.keys.has_tombstones
    assert scene.hear().get(timeout=PATIENCE) == ("b", b"kept")


def test_a_frame_that_comes_back_has_no_tombstone_any_more(scene: Scene) -> None:
    assert scene.keys.publish({"a": TOMBSTONE}) == []
    assert scene.keys.publish({"a": KEPT}) == []
    assert not scene.keys.has_tombstones
    assert scene.hear().get(timeout=PATIENCE) == ("a", b"kept")


def test_tombstones_are_limited_in_number(scene: Scene) -> None:
    assert scene.keys.publish({f"{number}": TOMBSTONE for number in range(1_001)}) == []
    assert len(scene.keys._tombstones) == 1_000
    assert "0" not in scene.keys._tombstones


def test_errors_of_frames_are_returned_one_for_each(scene: Scene) -> None:
    scene.sessions[0].close()
    errors = scene.keys.publish({"a": KEPT, "b": KEPT})
    assert [type(error) for error in errors] == [zenoh.ZError] * 2

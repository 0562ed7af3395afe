from typing import Any

import anyio
import pytest
import zenoh

from tfbus.links._receive_queue import Presence, Received
from tfbus.links.zenoh._filters import Filters
from tfbus.links.zenoh._keys import FIRST_SESSION, NO_ROBOT, Keys
from tfbus.links.zenoh._patch import Patch

pytestmark = pytest.mark.anyio

PEER, OTHER, STRANGER = (f"{number:032x}" for number in (1, 2, 3))


class Scene:
    """A patch that is not opened, and what it tells."""

    def __init__(self) -> None:
        self.items: list[Received] = []
        self.noted: list[tuple[Any, ...]] = []
        self.patch = Patch(
            zenoh.Config(),
            Keys("tf", f"{4:032x}"),
            PEER,
            self.items.append,
            lambda *noted: self.noted.append(noted),
            Filters(NO_ROBOT),
            lambda *_: None,
            lambda _: NO_ROBOT,
        )

    def connects(self, session: str) -> None:
        assert self.patch._note_connection is not None
        self.patch._note_connection(session, "tcp/127.0.0.1:1", "tcp/127.0.0.1:2")

    def hears(self, link: str, name: str = FIRST_SESSION, presence: Presence = Presence.JOINED) -> None:
        self.patch._note_presence(link, name, presence, NO_ROBOT)


async def test_what_a_patch_receives_is_of_its_peer_or_of_nobody() -> None:
    scene = Scene()
    for sender in (PEER, OTHER, ""):
        scene.patch._receive(Received(sender, b"x"))
    assert [item.sender for item in scene.items] == [PEER, ""]


async def test_only_the_presence_of_the_peer_is_told() -> None:
    scene = Scene()
    for link in (PEER, OTHER):
        for name in (FIRST_SESSION, "x"):
            scene.hears(link, name)
    scene.hears(PEER, "x", Presence.LEFT)
    notes = [(FIRST_SESSION, Presence.JOINED), ("x", Presence.JOINED), ("x", Presence.LEFT)]
    assert scene.noted == [(scene.patch, *note, NO_ROBOT) for note in notes]


async def test_the_wait_ends_with_the_peer_or_with_a_link_in_its_place() -> None:
    scene = Scene()
    with anyio.fail_after(5):
        await scene.patch.meet(lambda: True, 60.0)
        # A link that is heard through the peer, or without its first session, is not at the address.
        scene.hears(OTHER)
        scene.connects(STRANGER)
        scene.hears(STRANGER, "x")
        with anyio.move_on_after(0.1) as waiting:
            await scene.patch.meet(lambda: False, 60.0)
        assert waiting.cancelled_caught
        await scene.patch.meet(lambda: False, 0.01)
        scene.hears(STRANGER)
        await scene.patch.meet(lambda: False, 60.0)


@pytest.mark.parametrize(
    ("connected", "heard", "found"),
    [
        ([], [], None),
        ([], [OTHER], None),
        ([PEER], [OTHER], None),
        ([OTHER, PEER], [OTHER], None),
        ([OTHER], [STRANGER], (OTHER, False)),
        ([OTHER], [OTHER], (OTHER, True)),
    ],
)
async def test_who_is_at_the_address_is_told_by_the_connection(
    connected: list[str], heard: list[str], found: tuple[str, bool] | None
) -> None:
    scene = Scene()
    for session in connected:
        scene.connects(session)
    for link in heard:
        scene.hears(link)
    assert scene.patch.found_instead() == found

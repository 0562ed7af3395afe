import errno
from collections.abc import Iterator
from contextlib import AsyncExitStack, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest
import zenoh
from support.processes import free_address, until
from support.wires import LIVE, Ear, met
from support.zenoh_wires import listening, start_router, talk, way_to

from tfbus.links.seams import Joined, Left
from tfbus.links.zenoh import wire
from tfbus.links.zenoh.sessions import open_session, session_config
from tfbus.links.zenoh.zenoh_router import ZenohRouter

pytestmark = pytest.mark.anyio


@pytest.mark.thorough
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_routers_that_connect_to_each_other_tell_each_other_all_after_each_break(
    address: str, domain: str
) -> None:
    other = free_address()
    async with way_to(other) as way, way_to(address) as back:
        with start_router(address, way.address), start_router(other, back.address):
            async with listening(domain, connect=address) as one, listening(domain, connect=other) as two:
                for _ in range(3):
                    await met(one, two)
                    await talk(one, two)
                    starts = len(one.items), len(two.items)
                    await way.cut(far_only=True)
                    await back.cut()
                    await until(lambda starts=starts: has_lost(one, starts[0]) or has_lost(two, starts[1]))  # type: ignore[misc]
                await met(one, two)
                await talk(one, two)


def has_lost(ear: Ear, start: int) -> bool:
    return Left() in [item for _, item in ear.items[start:]]


@pytest.mark.thorough
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_routers_in_a_ring_tell_each_other_all_after_breaks_that_follow_fast(domain: str) -> None:
    addresses = [free_address() for _ in range(3)]
    async with AsyncExitStack() as stack:
        ways = [await stack.enter_async_context(way_to(address)) for address in addresses]
        for address, way in zip(addresses, ways[1:] + ways[:1], strict=True):
            stack.enter_context(start_router(address, way.address))
        ears = [await stack.enter_async_context(listening(domain, connect=address)) for address in addresses]
        for breaks in range(1, 4):
            await met(*ears)
            await talk(*ears)
            for _ in range(breaks):
                await until(lambda: all(way.open for way in ways))
                for way in ways:
                    await way.cut()
        await met(*ears)
        await talk(*ears)


async def test_a_router_listens_at_several_addresses(address: str, domain: str) -> None:
    other = free_address()
    async with (
        ZenohRouter([address, other]),
        listening(domain, connect=address) as one,
        listening(domain, connect=other) as two,
    ):
        await met(one, two)


async def test_an_address_in_use_is_an_os_error_and_a_router_is_entered_once(address: str) -> None:
    router = ZenohRouter(address)
    async with router:
        with pytest.raises(OSError, match="zenoh cannot open a session") as caught:
            async with ZenohRouter(address):
                raise AssertionError("it has opened")
        assert caught.value.errno == errno.EADDRINUSE
        assert ".rs:" not in str(caught.value)
        with pytest.raises(RuntimeError, match="entered once"):
            await router.__aenter__()
    async with ZenohRouter(address):
        pass


# Told nothing


@contextmanager
def silent_router(address: str) -> Iterator[None]:
    """A router with the id of one of tfbus that has no token, as one in which zenoh has panicked."""
    with open_session(session_config(address, (), None, None), {"id": b"tfbus".hex() + "5" * 22}):
        yield


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Begin anew soon after a router is connected without its token."""
    monkeypatch.setattr(wire, "PATIENCE", (0.4, 0.6))
    monkeypatch.setattr(wire, "PERIOD", 0.05)


@pytest.mark.usefixtures("impatient")
async def test_a_link_that_its_router_tells_nothing_says_so_and_connects_to_another_one(
    address: str, domain: str
) -> None:
    silent = free_address()
    with silent_router(silent):
        async with (
            ZenohRouter(address),
            listening(domain, connect=address) as one,
            listening(domain, connect=[silent, address]) as two,
        ):
            await met(one, two)
            await talk(one, two)
            (warning,) = two.warnings
            assert f"the router at {silent} tells nothing, and the link connects again" in str(warning)
            assert one.warnings == []


@pytest.mark.usefixtures("impatient")
async def test_a_link_that_is_told_of_others_stays_connected_without_the_token_of_its_router(
    address: str, domain: str
) -> None:
    async with (
        ZenohRouter(address, config=denying("liveliness_token", "tfbus/@router/*")),
        listening(domain, connect=address) as one,
    ):
        # The token does not come, so a link that is alone begins anew.
        await until(lambda: bool(one.warnings))
        async with listening(domain, connect=address) as two:
            await met(one, two)
            start = len(one.items), len(two.items)
            until_then = anyio.current_time() + 1.5
            while anyio.current_time() < until_then:
                await talk(one, two)
            for ear, items in zip((one, two), start, strict=True):
                assert Left() not in [item for _, item in ear.items[items:]]


def denying(message: str, key: str) -> dict[str, Any]:
    """The setting of a router that passes on no such messages."""
    rule = {"id": "rule", "messages": [message], "flows": ["egress"], "permission": "deny", "key_exprs": [key]}
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "allow",
            "rules": [rule],
            "subjects": [{"id": "all"}],
            "policies": [{"rules": ["rule"], "subjects": ["all"]}],
        }
    }


class Panic(BaseException):
    """As the exception by which a panic of zenoh comes to Python."""


class PanickingSession:
    """A session that panics when it is asked to declare something."""

    def __init__(self, *arguments: Any) -> None:
        self._session = open_session(*arguments)

    @property
    def info(self) -> Any:
        raise Panic("poisoned")

    def close(self) -> None:
        self._session.close()


@pytest.mark.parametrize("failing", ["broken", "panicking"])
async def test_a_router_whose_session_breaks_at_once_says_so(
    failing: str, address: str, domain: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wire, "open_session", broken_session if failing == "broken" else PanickingSession)
    with pytest.raises(OSError, match="the new session broke at once: "):
        async with ZenohRouter(address):
            raise AssertionError("it has opened")
    monkeypatch.undo()
    async with (
        ZenohRouter(address),
        listening(domain, connect=address) as one,
        listening(domain, connect=address) as two,
    ):
        await met(one, two)


def broken_session(*arguments: Any) -> zenoh.Session:
    session = open_session(*arguments)
    session.close()
    return session


@pytest.mark.usefixtures("impatient")
async def test_a_router_that_another_one_tells_nothing_has_a_new_session_and_says_once_while_it_gets_none(
    address: str, domain: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    silent = free_address()
    attempts: list[str] = []
    outcome = "in use"

    def attempt(config: zenoh.Config, own: dict[str, object]) -> zenoh.Session:
        if config.get_json("mode") == '"client"':
            return open_session(config, own)
        attempts.append(outcome)
        if outcome == "in use":
            raise OSError(f"{address} is in use")
        return broken_session(config, own) if outcome == "broken" else open_session(config, own)

    monkeypatch.setattr(wire, "LONGEST_CLOSE", 1.0)
    with ExitStack() as silence:
        silence.enter_context(silent_router(silent))
        async with (
            ZenohRouter(address, connect=silent),
            listening(domain, connect=address) as one,
            listening(domain, connect=address) as two,
        ):
            await met(one, two)
            monkeypatch.setattr(wire, "open_session", attempt)
            await until(lambda: bool(caplog.messages))
            await until(lambda: Left() in one.of(two))
            outcome = "broken"
            await until(lambda: outcome in attempts)
            silence.close()
            outcome = "lasting"
            await met(one, two)
            await talk(one, two)
            assert caplog.messages == [
                f"this router has no session, and goes on trying; a new process would have one: {address} is in use"
            ]


RULES = """{
  // Robots of the name guest publish nothing.
  access_control: {
    enabled: true,
    default_permission: "allow",
    rules: [{
      id: "publishing", messages: ["put"], flows: ["ingress"], permission: "deny", key_exprs: ["tfbus/*/guest/**"],
    }],
    subjects: [{id: "all"}],
    policies: [{rules: ["publishing"], subjects: ["all"]}],
  },
}"""


async def test_a_router_keeps_to_the_rules_of_a_file(address: str, domain: str, tmp_path: Path) -> None:
    file = tmp_path / "rules.json5"
    file.write_text(RULES, encoding="utf-8")
    async with (
        ZenohRouter(address, config=file),
        listening(domain, "guest", connect=address) as guest,
        listening(domain, "robot", connect=address) as robot,
        listening(domain, connect=address) as hears,
    ):
        await met(guest, robot, hears)
        guest.wire.publish(LIVE, b"refused")
        assert guest.wire.send(hears.id, b"a question")
        await until(lambda: hears.of(guest) == [Joined("guest"), b"a question"])
        robot.wire.publish(LIVE, b"published")
        await until(lambda: hears.of(robot) == [Joined("robot"), b"published"])
        assert hears.of(guest) == [Joined("guest"), b"a question"]


def test_a_file_of_settings_wins_over_those_of_the_router_but_for_addresses(tmp_path: Path) -> None:
    file = tmp_path / "settings.json5"
    file.write_text("{transport: {link: {tx: {lease: 7000}}}}", encoding="utf-8")
    config = session_config("tcp/127.0.0.1:0", (), str(file), 2.0)
    assert config.get_json("transport/link/tx/lease") == "7000"
    assert config.get_json("scouting/multicast/enabled") == "false"
    for text, problem in (
        ('{listen: {endpoints: ["tcp/0.0.0.0:1"]}}', "'listen/endpoints' is not for config: give addresses by"),
        ("{no_such_setting: 1}", "zenoh does not take the settings in .*settings.json5: unknown field"),
        ("garbage", "zenoh does not take the settings in"),
    ):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=problem):
            ZenohRouter(config=file)
    with pytest.raises(FileNotFoundError):
        ZenohRouter(config=tmp_path / "none.json5")


@pytest.mark.thorough
@pytest.mark.every_loop
async def test_a_router_whose_opening_is_cancelled_at_any_moment_frees_its_address(address: str) -> None:
    for tenths in range(60):
        with anyio.move_on_after(tenths / 10_000):
            async with ZenohRouter(address):
                await anyio.sleep_forever()
    async with ZenohRouter(address):
        pass

"""Lookups in the buffers of other processes: `DomainLink.lookup` asks, a `BufferServer` answers."""

import json
import math
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import numpy as np
import pytest
from support.asking import Asked, settle
from support.memory_wire import MemoryNetwork, MemoryWire
from support.processes import until
from support.samples import moving, static
from support.worlds import random_covariance, random_transform
from trio.testing import MockClock

from tfbus import (
    LATEST,
    Buffer,
    Bus,
    Clock,
    Covariance,
    DisconnectedError,
    FutureExtrapolationError,
    Hold,
    LookupTimeoutError,
    PastExtrapolationError,
    RemoteLookupError,
    SimulatedClock,
    Transform,
    TransformStamped,
    UncertainSample,
    UncertainTransform,
    UnknownFrameError,
    joint,
)
from tfbus.links import BufferServer, DomainLink
from tfbus.links.message import (
    Kind,
    Outgoing,
    RemoteQuestion,
    kind_of,
    read_answer,
    write_answer,
    write_body,
    write_message,
    write_question,
)
from tfbus.links.seams import Hearing

pytestmark = pytest.mark.anyio


class Scene:
    """A link whose robot serves a buffer, and one that asks and hears nothing else."""

    def __init__(
        self, network: MemoryNetwork, buffer: Buffer, server: BufferServer, asker: DomainLink, link: DomainLink
    ):
        self.network = network
        self.buffer = buffer
        self.bus = buffer.bus
        self.server = server
        self.asker = asker
        self.link = link

    async def lookup(self, *arguments: Any, **options: Any) -> TransformStamped:
        found: TransformStamped = await self.asker.lookup(*arguments, robot="r1", **options)
        return found

    @property
    def counts(self) -> dict[str, Any]:
        statistics = self.server.statistics()
        found = statistics.to_dict()
        return {name: found[name] for name in ("waiting", "answered", "failed", "cancelled", "refused") if found[name]}


@asynccontextmanager
async def asked(clock: Clock | None = None, **options: Any) -> AsyncIterator[Scene]:
    network = MemoryNetwork()
    with Bus(clock) as bus, Buffer(bus) as buffer, Bus() as other:
        async with (
            DomainLink(bus, "tf", network.wire("r1"), robot="r1") as link,
            BufferServer(buffer, link, **options) as server,
            DomainLink(other, "tf", network.wire(), robots={"r1": 0.0}) as asker,
        ):
            yield Scene(network, buffer, server, asker, link)
        assert other.statistics().samples == 0, "a link of rate 0 hears nothing but answers"


async def test_a_server_is_entered_once_and_is_the_only_one_of_its_link() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        async with DomainLink(bus, "tf", MemoryNetwork().wire("r1"), robot="r1") as link:
            async with BufferServer(buffer, link) as server:
                with pytest.raises(RuntimeError, match="serves a buffer already"):
                    await BufferServer(buffer, link).__aenter__()
            with pytest.raises(RuntimeError, match="entered once"):
                await server.__aenter__()


@pytest.mark.every_loop
async def test_a_lookup_is_answered_at_once_or_waits_there_until_it_can_be() -> None:
    async with asked() as scene:
        scene.bus.publish(
            [static("base", "lidar", x=2.0), moving("map", "base", 5, x=1.0), moving("map", "base", 9, x=5.0)]
        )
        found = await scene.lookup("map", "lidar")
        assert (found.parent, found.child, found.stamp, found.transform.translation) == ("map", "lidar", 9, (7, 0, 0))
        assert (await scene.lookup("map", "base", 6)).transform.translation == (2, 0, 0)
        held = await scene.lookup("map", "base", 12, extrapolate=Hold(1.0))
        assert (held.transform.translation, held.extrapolated_by) == ((5, 0, 0), 3)
        travelled = await scene.lookup("base", "base", 9, source_at=5, fixed="map")
        assert travelled.transform.translation == (-4, 0, 0)
        async with anyio.create_task_group() as tasks:
            waiting = Asked(tasks, lambda: scene.lookup("map", "base", 20))
            await until(lambda: scene.server.statistics().waiting == 1)
            scene.bus.publish(moving("map", "base", 20, x=8.0))
        assert waiting.answer.transform.translation == (8, 0, 0)
        assert scene.counts == {"answered": 5}


@pytest.mark.every_loop
async def test_an_answer_with_its_error_is_that_of_the_other_buffer_and_has_its_edges_in_common_with_others() -> None:
    async with asked() as scene, anyio.create_task_group() as tasks:
        rng = np.random.default_rng(1)
        scene.bus.publish([static("base", "lidar", x=2.0), static("map", "odom")])
        for second in range(3):
            error = Covariance((1.0 + second) * random_covariance(rng, 0.1, 0.05))
            place = random_transform(rng)
            scene.bus.publish(UncertainSample("odom", "base", second, place, covariance=error, kind="drift"))
        ask: list[tuple[tuple[Any, ...], dict[str, Any]]] = [
            (("map", "lidar"), {}),
            (("lidar", "map", 1), {}),
            (("base", "base", 2), {"source_at": 0, "fixed": "odom"}),
            (("map", "base", 5), {"extrapolate": Hold(1.0)}),
            (("map", "map", 5), {}),
        ]
        found: list[UncertainTransform] = []
        known: list[UncertainTransform] = []
        for arguments, options in ask:
            found.append(await scene.asker.lookup(*arguments, **options, robot="r1", covariance=True))
            known.append(scene.buffer.lookup_nowait(*arguments, **options, covariance=True))
        for far, near in zip(found, known, strict=True):
            assert (far, far.exact, far.linear) == (near, near.exact, near.linear)
            assert (far.extrapolated_by, far.gap) == (near.extrapolated_by, near.gap)
            assert far.covariance == near.covariance
        # A far answer and a near one share the errors of their edges.
        assert np.array_equal(joint([found[0], known[1]]).covariance, joint(known[:2]).covariance)
        assert not joint([found[0], known[0]]).difference(0, 1).any()
        waiting = Asked(tasks, lambda: scene.lookup("map", "base", 20, covariance=True))
        await until(lambda: scene.server.statistics().waiting == 1)
        scene.bus.publish(moving("odom", "base", 20))
        await until(lambda: waiting.ended)
        assert isinstance(waiting.answer, UncertainTransform)
        assert waiting.answer.exact == (("map", "odom"), ("odom", "base"))


async def test_each_error_is_that_of_the_other_buffer_with_its_facts() -> None:
    async with asked() as scene:
        scene.bus.publish([moving("map", "base", 5, authority="odometry"), moving("world", "other", 5)])
        with pytest.raises(PastExtrapolationError) as past:
            await scene.lookup("map", "base", 4)
        facts = past.value
        assert (facts.child, facts.stamp, facts.oldest, facts.authority) == ("base", 4, 5, "odometry")
        with pytest.raises(LookupTimeoutError) as late:
            await scene.lookup("map", "base", 6, timeout=0.0)
        assert (late.value.timeout, late.value.target, late.value.source) == (0.0, "map", "base")
        assert isinstance(late.value.__cause__, FutureExtrapolationError)
        assert late.value.__cause__.newest == 5
        for source, kind in (("bse", UnknownFrameError), ("other", DisconnectedError)):
            with pytest.raises(LookupTimeoutError) as missing:
                await scene.lookup("map", source, timeout=0.0)
            assert isinstance(missing.value.__cause__, kind)
        with pytest.raises(TypeError, match="fixed"):
            await scene.lookup("map", "base", source_at=3)
        assert scene.counts == {"failed": 5}
        # An invalid question is refused before any peer is asked.
        for error, options in (
            (TypeError, {"at": 1.5}),
            (ValueError, {"timeout": -1.0}),
            (ValueError, {"max_gap": -1.0}),
            (ValueError, {"max_age": math.nan}),
        ):
            with pytest.raises(error):
                await scene.lookup("map", "base", **options)
        assert scene.counts == {"failed": 5}


@pytest.mark.every_loop
async def test_a_lookup_that_is_given_up_is_cancelled_there() -> None:
    async with asked() as scene:
        async with anyio.create_task_group() as tasks:
            for _ in range(3):
                tasks.start_soon(scene.lookup, "map", "base")
            await until(lambda: scene.server.statistics().waiting == 3)
            tasks.cancel_scope.cancel()
        await until(lambda: scene.server.statistics().waiting == 0)
        assert scene.counts == {"cancelled": 3}


async def test_the_end_of_an_asker_ends_its_lookups_here_and_there_and_no_others() -> None:
    async with asked() as scene, anyio.create_task_group() as tasks:
        stays = Asked(tasks, lambda: scene.lookup("map", "base"))
        with Bus() as bus:
            # Which is another link of the robot.
            async with DomainLink(bus, "tf", scene.network.wire("r1"), robot="r1") as other:
                ends = Asked(tasks, lambda: other.lookup("map", "base", robot="r1"))
                await until(lambda: scene.server.statistics().waiting == 2)
            with pytest.raises(RuntimeError, match="not entered"):
                await other.lookup("map", "base")
        await until(lambda: ends.ended and scene.server.statistics().waiting == 1)
        assert isinstance(ends.error, RemoteLookupError)
        assert (ends.error.reason, scene.counts) == ("lost", {"waiting": 1, "cancelled": 1})
        scene.bus.publish(static("map", "base"))
        await until(lambda: stays.ended)
        assert stays.answer.static


@pytest.mark.parametrize("end", ["server", "link", "kill"])
async def test_a_server_that_goes_ends_the_lookups_that_wait_there(end: str) -> None:
    network = MemoryNetwork()
    with Bus() as bus, Buffer(bus) as buffer, Bus() as other:
        async with DomainLink(other, "tf", network.wire()) as asker, anyio.create_task_group() as tasks:
            async with DomainLink(bus, "tf", network.wire()) as link:
                async with BufferServer(buffer, link) as server:
                    waiting = Asked(tasks, lambda: asker.lookup("map", "base"))
                    await until(lambda: server.statistics().waiting == 1)
                    if end == "kill":
                        network.kill(link.id)
                        await until(lambda: waiting.ended)
                if end == "server":
                    await until(lambda: waiting.ended)
            await until(lambda: waiting.ended)
            assert isinstance(waiting.error, RemoteLookupError)
            assert waiting.error.reason == "lost"


async def test_a_server_that_is_not_there_is_waited_for_no_longer_than_the_lookup_is() -> None:
    network = MemoryNetwork()
    with Bus() as bus, Buffer(bus) as buffer, Bus() as other:
        bus.publish(static("map", "base"))
        async with (
            DomainLink(other, "tf", network.wire()) as asker,
            DomainLink(bus, "tf", network.wire("r1"), robot="r1") as link,
        ):
            for robot in (None, "r1"):
                with pytest.raises(RemoteLookupError) as absent:
                    await asker.lookup("map", "base", robot=robot, timeout=0.01)
                assert (absent.value.reason, absent.value.domain, absent.value.robot) == ("absent", "tf", robot)
            async with anyio.create_task_group() as tasks:
                early = Asked(tasks, lambda: asker.lookup("map", "base", robot="r1"))
                await settle()
                async with BufferServer(buffer, link):
                    await until(lambda: early.ended)
            assert early.answer.static


async def test_more_lookups_than_may_wait_or_come_are_refused_and_counted() -> None:
    async with asked(capacity=2) as scene, anyio.create_task_group() as tasks:
        for _ in range(2):
            tasks.start_soon(scene.lookup, "map", "base")
        await until(lambda: scene.server.statistics().waiting == 2)
        with pytest.raises(RemoteLookupError) as busy:
            await scene.lookup("map", "base")
        assert busy.value.reason == "busy"
        assert scene.counts == {"waiting": 2, "refused": {"busy": 1}}
        scene.bus.publish(static("map", "base"))
        await until(lambda: scene.server.statistics().answered == 2)
    async with asked(rate=1.0) as scene:
        scene.bus.publish(static("map", "base"))
        await scene.lookup("map", "base")
        with pytest.raises(RemoteLookupError) as busy:
            await scene.lookup("map", "base")
        assert (busy.value.reason, scene.counts) == ("busy", {"answered": 1, "refused": {"busy": 1}})


async def test_a_server_is_entered_once_with_an_entered_link_that_serves_no_other() -> None:
    network = MemoryNetwork()
    with Bus() as bus, Buffer(bus) as buffer:
        for options in ({"capacity": 0}, {"rate": 0.0}, {"rate": math.nan}):
            with pytest.raises(ValueError, match=r"."):
                BufferServer(buffer, DomainLink(bus, "tf", network.wire()), **options)
        link = DomainLink(bus, "tf", network.wire())
        with pytest.raises(RuntimeError, match="not entered"):
            await BufferServer(buffer, link).__aenter__()
        async with link:
            async with BufferServer(buffer, link) as server:
                for another in (server, BufferServer(buffer, link)):
                    with pytest.raises(RuntimeError):
                        await another.__aenter__()
            async with BufferServer(buffer, link):
                pass


async def test_hundreds_of_lookups_at_once_are_each_answered() -> None:
    async with asked() as scene, anyio.create_task_group() as tasks:
        many = [Asked(tasks, lambda: scene.lookup("map", "base")) for _ in range(300)]
        await until(lambda: scene.server.statistics().waiting == 300)
        scene.bus.publish(static("map", "base"))
        await until(lambda: all(one.ended for one in many))
        assert all(one.answer.static for one in many)
        assert scene.counts == {"answered": 300}


# The time of a lookup

in_simulated_time = pytest.mark.parametrize(
    "anyio_backend", [("trio", {"clock": MockClock(autojump_threshold=0)})], ids=["simulated"]
)


@pytest.mark.every_loop
@in_simulated_time
async def test_a_long_wait_is_asked_for_in_parts() -> None:
    async with asked() as scene, anyio.create_task_group() as tasks:
        waiting = Asked(tasks, lambda: scene.lookup("map", "base"))
        await until(lambda: scene.server.statistics().failed >= 2)
        scene.bus.publish(static("map", "base"))
        await until(lambda: waiting.ended)
        assert waiting.answer.static
        with pytest.raises(LookupTimeoutError) as late:
            await scene.lookup("map", "nothing", timeout=25.0)
        assert late.value.timeout == 25.0
        assert isinstance(late.value.__cause__, UnknownFrameError)
        # No asker makes the server wait longer than ten seconds.
        stranger = Stranger(scene.network, "r3")
        await stranger.open()
        for number, timeout in enumerate((None, 1e6, math.nan)):
            question = RemoteQuestion("map", "nothing", LATEST, timeout=timeout)
            stranger.say(scene.link.id, Kind.LOOKUP, number.to_bytes(8, "little") + write_question(question))
        await until(lambda: scene.server.statistics().waiting == 3)
        await anyio.sleep(10.1)
        assert len(stranger.bodies) == 3


@pytest.mark.every_loop
@in_simulated_time
async def test_a_lookup_waits_for_a_server_whose_simulated_clock_stands_still() -> None:
    async with asked(SimulatedClock()) as scene, anyio.create_task_group() as tasks:
        waiting = Asked(tasks, lambda: scene.lookup("map", "base"))
        with pytest.raises(LookupTimeoutError) as late:
            await scene.lookup("map", "nothing", timeout=60.0)
        assert isinstance(late.value.__cause__, UnknownFrameError)
        scene.bus.publish(static("map", "base"))
        await until(lambda: waiting.ended)
        assert waiting.answer.static


@in_simulated_time
@pytest.mark.parametrize(("timeout", "waited"), [(None, 3.0), (2.0, 2.0), (30.0, 3.0)])
async def test_a_server_is_waited_for_three_seconds_at_most(timeout: float | None, waited: float) -> None:
    # The server of another robot has come before.
    async with asked() as scene:
        scene.bus.publish(static("map", "base"))
        await scene.lookup("map", "base")
        began = anyio.current_time()
        with pytest.raises(RemoteLookupError, match="nobody offers it"):
            await scene.asker.lookup("map", "base", timeout=timeout)
        assert anyio.current_time() - began == pytest.approx(waited)


@pytest.mark.every_loop
@in_simulated_time
async def test_a_lookup_that_waits_for_a_server_ends_with_its_link() -> None:
    async with anyio.create_task_group() as tasks:
        async with DomainLink(Bus(), "tf", MemoryNetwork().wire()) as asker:
            waiting = Asked(tasks, lambda: asker.lookup("map", "base"))
            await settle()
            began = anyio.current_time()
        await until(lambda: waiting.ended)
    assert isinstance(waiting.error, RemoteLookupError)
    assert waiting.error.reason == "lost"
    assert anyio.current_time() - began < 1.0


@pytest.mark.every_loop
@in_simulated_time
@pytest.mark.parametrize("lost", [Kind.LOOKUP, Kind.LOOKUP_ANSWER])
async def test_what_is_dropped_is_asked_again_and_a_silent_server_is_given_up(lost: Kind) -> None:
    async with asked() as scene:
        scene.bus.publish(static("map", "base"))
        await scene.lookup("map", "base")
        dropped: list[bytes] = []

        def lose(most: int) -> Callable[[str, str, bytes], bool]:
            def loses(_sender: str, _link: str, message: bytes) -> bool:
                if kind_of(message) is lost and len(dropped) < most:
                    dropped.append(message)
                    return True
                return False

            return loses

        scene.network.lose = lose(2)
        assert (await scene.lookup("map", "base")).static
        # A server waits for ten seconds at most, its answer comes within three more, and it is asked four times.
        for timeout, given_up in ((None, 4 * 13.0), (2.0, 2.0 + 3.0)):
            dropped.clear()
            began = anyio.current_time()
            scene.network.lose = lose(100)
            with pytest.raises(RemoteLookupError) as silent:
                await scene.lookup("map", "base", timeout=timeout)
            assert silent.value.reason == "silent"
            waited = given_up if lost is Kind.LOOKUP_ANSWER else 0.0
            assert anyio.current_time() - began == pytest.approx(waited)
            scene.network.lose = lose(0)


@pytest.mark.every_loop
@in_simulated_time
async def test_a_server_that_answers_again_may_be_silent_again() -> None:
    async with asked() as scene, anyio.create_task_group() as tasks:
        answers: list[bytes] = []

        def lose(_sender: str, _link: str, message: bytes) -> bool:
            if kind_of(message) is Kind.LOOKUP_ANSWER:
                answers.append(message)
            return kind_of(message) is Kind.LOOKUP_ANSWER and len(answers) % 2 == 0

        scene.network.lose = lose
        waiting = Asked(tasks, lambda: scene.lookup("map", "base"))
        # More often in all than a server may be silent in a row.
        await anyio.sleep(120.0)
        assert len(answers) > 8
        scene.bus.publish(static("map", "base"))
        await until(lambda: waiting.ended)
        assert waiting.answer.static


# Strangers


class Stranger:
    """A wire that a test uses itself: it says that it serves a buffer, and answers as the test likes."""

    def __init__(self, network: MemoryNetwork, robot: str = "r1") -> None:
        self.wire: MemoryWire = network.wire(robot)
        self.bodies: list[tuple[str, bytes]] = []

    async def open(self) -> None:
        await self.wire.open([Hearing("*", "all")], self._receive, print)
        for channel in ("all", "none"):
            self.wire.publish(channel, write_message(Outgoing(Kind.SIGN, os.urandom(16), serves=True)))

    def _receive(self, link: str, item: Any) -> None:
        if isinstance(item, bytes) and kind_of(item) in (Kind.LOOKUP, Kind.LOOKUP_ANSWER):
            self.bodies.append((link, item[2:]))

    def say(self, link: str, kind: Kind, body: bytes) -> None:
        self.wire.send(link, write_body(kind, body))


FOUND = TransformStamped("map", "base", 7, Transform((0.1, 0.2, 1 / 3)))
QUESTION = RemoteQuestion("map", "base", LATEST)


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"garbage",
        b"[]",
        b"{}",
        b"[" * 60_000,
        write_answer(FOUND.replace(child="arm")),
        b'{"type": "RecordingError"}',
    ],
)
async def test_whatever_a_server_answers_a_lookup_has_its_answer_or_a_remote_lookup_error(answer: bytes) -> None:
    network = MemoryNetwork()
    with Bus() as bus:
        async with DomainLink(bus, "tf", network.wire()) as asker, anyio.create_task_group() as tasks:
            stranger, other = Stranger(network), Stranger(network, "r2")
            await stranger.open()
            await other.open()
            waiting = Asked(tasks, lambda: asker.lookup("map", "base", 7, robot="r1"))
            await until(lambda: bool(stranger.bodies))
            number = stranger.bodies[0][1][:8]
            # Others cannot answer, nor can an answer to another question.
            other.say(asker.id, Kind.LOOKUP_ANSWER, number + write_answer(FOUND))
            for never in (bytes(8), b"\xff" * 8):
                stranger.say(asker.id, Kind.LOOKUP_ANSWER, never + write_answer(FOUND))
            stranger.say(asker.id, Kind.LOOKUP_ANSWER, b"")
            await settle()
            assert not waiting.ended
            assert asker.statistics().rejected == {"lookup": 3}
            stranger.say(asker.id, Kind.LOOKUP_ANSWER, number + answer)
            await until(lambda: waiting.ended)
            assert isinstance(waiting.error, RemoteLookupError)
            assert waiting.error.reason == "malformed"
            again = Asked(tasks, lambda: asker.lookup("map", "base", 7, robot="r1"))
            await until(lambda: len(stranger.bodies) == 2)
            stranger.say(asker.id, Kind.LOOKUP_ANSWER, stranger.bodies[1][1][:8] + write_answer(FOUND))
            await until(lambda: again.ended)
            assert again.answer == FOUND


async def test_an_answer_without_the_covariance_that_was_asked_for_is_a_remote_lookup_error() -> None:
    network = MemoryNetwork()
    with Bus() as bus:
        async with DomainLink(bus, "tf", network.wire()) as asker, anyio.create_task_group() as tasks:
            stranger = Stranger(network)
            await stranger.open()
            waiting = Asked(tasks, lambda: asker.lookup("map", "base", 7, robot="r1", covariance=True))
            await until(lambda: bool(stranger.bodies))
            stranger.say(asker.id, Kind.LOOKUP_ANSWER, stranger.bodies[0][1][:8] + write_answer(FOUND))
            await until(lambda: waiting.ended)
            assert isinstance(waiting.error, RemoteLookupError)
            assert "not an answer: it has no covariance" in str(waiting.error)


async def test_what_is_no_question_is_refused_and_counted_and_harms_nobody() -> None:
    async with asked() as scene:
        scene.bus.publish(static("map", "base"))
        stranger = Stranger(scene.network, "r3")
        await stranger.open()
        fields = QUESTION.to_dict()
        bad = [b"garbage", b"{}", b"[" * 60_000, b"x" * 100_000, b'{"type": "RemoteQuestion"}']
        hostile: list[dict[str, Any]] = [{name: int("9" * 401)} for name in ("timeout", "max_age", "hold", "at")]
        hostile += [{"max_gap": 2**64}, {"max_gap": [[[[[]]]]]}, {"target": "m" * 2_000}, {"type": [0] * 1_000}]
        bad += [json.dumps(fields | change).encode() for change in hostile]
        for number, body in enumerate(bad):
            stranger.say(scene.link.id, Kind.LOOKUP, number.to_bytes(8, "little") + body)
        await until(lambda: len(stranger.bodies) == len(bad))
        assert [int.from_bytes(body[:8], "little") for _, body in stranger.bodies] == list(range(len(bad)))
        for _, body in stranger.bodies:
            with pytest.raises(RemoteLookupError) as refused:
                read_answer(body[8:], "tf", None)
            assert refused.value.reason == "malformed"
        stranger.say(scene.link.id, Kind.LOOKUP, b"")
        assert (await scene.lookup("map", "base")).static
        assert scene.counts == {"answered": 1, "refused": {"malformed": len(bad)}}


async def test_a_number_under_which_a_lookup_waits_is_refused_for_another_and_cancelled_by_its_asker_only() -> None:
    async with asked() as scene:
        one, other = Stranger(scene.network, "r3"), Stranger(scene.network, "r4")
        await one.open()
        await other.open()
        number = (5).to_bytes(8, "little")
        for _ in range(2):
            one.say(scene.link.id, Kind.LOOKUP, number + write_question(QUESTION))
        await until(lambda: len(one.bodies) == 1)
        other.say(scene.link.id, Kind.LOOKUP, number)
        await settle()
        assert scene.counts == {"waiting": 1, "refused": {"malformed": 1}}
        one.say(scene.link.id, Kind.LOOKUP, number)
        await until(lambda: scene.server.statistics().waiting == 0)
        scene.bus.publish(static("map", "base"))
        await settle()
        assert len(one.bodies) == 1, "a question that was cancelled has no answer"


async def test_an_error_of_the_buffer_that_no_lookup_raises_fails_the_question_only(
    caplog: pytest.LogCaptureFixture,
) -> None:
    class Broken(Buffer):
        def lookup_nowait(self, *arguments: Any, **options: Any) -> Any:
            if options["target"] == "map":
                raise ZeroDivisionError("a bug")
            return super().lookup_nowait(*arguments, **options)

    network = MemoryNetwork()
    with Bus() as bus, Broken(bus) as buffer, Bus() as other:
        bus.publish(static("odom", "base"))
        async with (
            DomainLink(bus, "tf", network.wire()) as link,
            BufferServer(buffer, link) as server,
            DomainLink(other, "tf", network.wire()) as asker,
        ):
            for _ in range(2):
                with pytest.raises(RemoteLookupError) as failed:
                    await asker.lookup("map", "base")
                assert (failed.value.reason, "ZeroDivisionError" in failed.value.detail) == ("internal", True)
            assert (await asker.lookup("odom", "base")).static
            assert server.statistics().refused == {"internal": 2}
    assert sum("a lookup of another process failed" in message for message in caplog.messages) == 1

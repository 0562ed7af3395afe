"""Joining a domain or ROS: addresses, event loops, the clock of a replay, and static frames."""

import asyncio
import errno
import os
import re
import signal
import socket
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import anyio
import anyio.lowlevel
import pytest
from support.asking import settle
from support.both_sides import URDF
from support.commands import START, Command, check_wrong_call
from support.processes import PATIENCE, new_dds_domain, new_domain, start_tfbus, until
from support.samples import moving, static

from tfbus import (
    SECOND,
    Buffer,
    Bus,
    ClockResetError,
    LocalLink,
    SimulatedClock,
    SystemClock,
    Transform,
    TransformBroadcaster,
    TransformStamped,
    from_seconds,
)
from tfbus.cli.arguments import UsageError
from tfbus.cli.domain import HearingOptions, LinkOptions, RemoteLookups, is_ros, publish_static, ros_link, run
from tfbus.cli.replay_clock import ReplayClock
from tfbus.links import BufferServer
from tfbus.testing import simulate

NOBODY = "tcp/127.0.0.1:1"
BACKENDS = ["asyncio", "trio"]


def join(options: LinkOptions) -> None:
    """Join a domain and leave it again."""

    async def stay_for_a_moment(_: Bus) -> None:
        await anyio.lowlevel.checkpoint()

    options.run(stay_for_a_moment)


def test_a_program_asks_the_buffer_of_a_robot_and_of_one_robot_only() -> None:
    domain = new_domain()

    async def serve_and_ask(remote: RemoteLookups) -> TransformStamped:
        with Bus() as bus, Buffer(bus) as buffer:
            bus.publish(static("map", "base", 2.0))
            async with LocalLink(bus, domain, robot="r1") as link, BufferServer(buffer, link):
                return await remote.lookup("map", "base", timeout=PATIENCE)

    assert LinkOptions(domain, robots=("r1",)).run_remote(serve_and_ask).transform.translation == (2.0, 0.0, 0.0)
    with pytest.raises(UsageError, match="one robot"):
        LinkOptions(domain, robots=("r1", "r2")).run_remote(serve_and_ask)


def test_an_address_of_any_protocol_is_tried_in_the_background() -> None:
    tcp = ("tcp/127.0.0.1:1", "tcp/127.0.0.1:1?prio=1-7", "tcp/[::1]:1", "ws/127.0.0.1:1", "udp/localhost:1")
    others = ("tls/localhost:1#root_ca_certificate=/nowhere/ca.pem", "unixsock-stream//nowhere/at/all")
    join(LinkOptions(new_domain(), connect=tcp + others))


@pytest.mark.parametrize("command", ["tree", "tree --backend trio", "router"])
def test_an_address_in_use_is_a_usage_error(command: str, tfbus: Command) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        done = tfbus(*command.split(), "--listen", address)
    check_wrong_call(done, f"cannot listen at {address}: {os.strerror(errno.EADDRINUSE)}")


def test_without_its_extra_joining_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tfbus.links.zenoh", None)
    for options in (LinkOptions(connect=(NOBODY,)), LinkOptions(listen=(NOBODY,))):
        with pytest.raises(UsageError, match=re.escape('need one more package: pip install "tfbus[cli,zenoh]"')):
            join(options)


def test_a_directory_that_others_can_enter_is_a_usage_error_that_says_what_to_do(
    tfbus: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The folder of pytest has too long a path for a socket.
    with TemporaryDirectory() as place:
        Path(place).chmod(0o755)
        monkeypatch.setenv("TFBUS_RUNTIME_DIR", place)
        check_wrong_call(tfbus("tree"), f"other users can enter it: run chmod 700 {place}, or set TFBUS_RUNTIME_DIR")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (LinkOptions(), "hears 1 peer on this machine"),
        (LinkOptions(robots=("r1",)), "hears nobody on this machine"),
        (LinkOptions(listen=("tcp/127.0.0.1:0",)), "hears nobody by the router of this program at tcp/127.0.0.1:0"),
        (LinkOptions(connect=(NOBODY, "tcp/a:1")), f"hears nobody by a router at {NOBODY} or tcp/a:1"),
    ],
)
def test_it_is_said_whom_a_program_hears_and_how(
    options: LinkOptions, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    options = replace(options, domain=new_domain())

    async def meet() -> None:
        met = anyio.Event()
        with Bus() as bus, Bus() as other, bus.subscribe(lambda _: met.set()):
            async with options.join(bus) as links, LocalLink(other, options.domain):
                if "1 peer" in said:
                    other.publish(static("map", "odom"))
                    await met.wait()
                options.print_peers(links)

    anyio.run(meet)
    assert capsys.readouterr() == ("", f"{said}\n")


class Ahead(SystemClock):
    def now(self) -> int:
        return super().now() + 3_600 * SECOND


@pytest.mark.parametrize(("correct_clocks", "ahead"), [(False, 3_600), (True, 0)])
def test_stamps_of_another_clock_are_moved_to_that_of_this_machine_if_asked(correct_clocks: bool, ahead: int) -> None:
    options = HearingOptions(new_domain(), correct_clocks=correct_clocks)

    async def meet() -> None:
        with Bus() as bus, Bus(Ahead()) as other, Buffer(bus) as buffer:
            async with options.join(bus) as (link,), LocalLink(other, options.domain):
                await until(lambda: any(clock.offset for clock in link.statistics().clocks))
                TransformBroadcaster(other).send("map", "cart", Transform())
                stamp = (await buffer.lookup("map", "cart", timeout=PATIENCE)).stamp
                assert abs(bus.clock.now() + ahead * SECOND - stamp) < 60 * SECOND

    anyio.run(meet)


@pytest.mark.parametrize(("seconds", "notice"), [(0.9, ""), (60.0, "waiting for transforms on domain 'yard' …\n")])
def test_waiting_for_the_first_transform_is_announced_once_if_it_takes_more_than_a_second(
    seconds: float, notice: str, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = SimulatedClock(START)

    async def wait_beside_publisher() -> int:
        with Bus(clock) as bus:

            async def publish() -> None:
                await clock.sleep(seconds)
                bus.publish(static("map", "odom"))

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(publish)
                await LinkOptions("yard").first_transform(bus)
            return clock.now()

    assert anyio.run(simulate, clock, wait_beside_publisher) == START + from_seconds(seconds)
    assert capsys.readouterr() == ("", notice)


@pytest.mark.thorough
def test_leaving_a_domain_survives_being_cancelled_twice(caplog: pytest.LogCaptureFixture) -> None:
    # Process managers repeat a Ctrl-C that all processes have had already, and asyncio makes a cancel of each.
    async def stay(joined: asyncio.Event) -> None:
        with Bus() as bus:
            async with LinkOptions(new_domain(), listen=("tcp/127.0.0.1:0",)).join(bus):
                joined.set()
                await asyncio.sleep(1e9)

    async def cancel_twice() -> None:
        for turns in range(12):
            joined = asyncio.Event()
            task = asyncio.create_task(stay(joined))
            await joined.wait()
            task.cancel()
            for _ in range(turns):
                await asyncio.sleep(0)
            task.cancel()
            await asyncio.wait([task])
            assert task.cancelled()

    asyncio.run(cancel_twice())
    assert caplog.records == []


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("backend", BACKENDS)
def test_ctrl_c_cancels_and_is_raised_after_the_cleanup_even_if_pressed_again(backend: str) -> None:
    ended = []

    async def main() -> None:
        try:
            press_ctrl_c()
            await anyio.sleep_forever()
        finally:
            with anyio.CancelScope(shield=True):
                for _ in range(3):
                    press_ctrl_c()
                    await anyio.sleep(0.01)
            ended.append(backend)

    with pytest.raises(KeyboardInterrupt):
        run(main, backend)
    assert ended == [backend]


@pytest.mark.parametrize("backend", BACKENDS)
def test_ctrl_c_is_raised_even_if_the_function_ends_by_itself_and_an_error_without_a_group(backend: str) -> None:
    async def end() -> None:
        with anyio.CancelScope(shield=True):
            press_ctrl_c()
            await anyio.sleep(0.01)

    async def fail() -> None:
        raise OSError("no")

    async def fail_in_the_cleanup() -> None:
        try:
            press_ctrl_c()
            await anyio.sleep_forever()
        finally:
            raise OSError("no")

    with pytest.raises(KeyboardInterrupt):
        run(end, backend)
    for main in (fail, fail_in_the_cleanup):
        with pytest.raises(OSError, match="no"):
            run(main, backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_ctrl_c_stays_ignored_where_it_was_ignored(backend: str) -> None:
    done = []

    async def main() -> None:
        press_ctrl_c()
        await anyio.sleep(0.01)
        done.append(backend)

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        run(main, backend)
    finally:
        signal.signal(signal.SIGINT, before)
    assert done == [backend]


THEN = 1_400_000_000 * SECOND


@pytest.mark.anyio
async def test_it_is_the_machine_s_time_until_a_stamp_is_heard_and_then_that() -> None:
    clock = ReplayClock()
    jumps: list[tuple[int, int]] = []
    registration = clock.on_jump(lambda before, after: jumps.append((before, after)))
    earlier = time.time_ns()
    assert earlier <= clock.now() <= time.time_ns()
    clock.hear(THEN)
    clock.hear(THEN + 5)
    assert clock.now() == THEN + 5
    assert jumps == [(THEN, THEN)], "it is another clock's time, so no jump back"
    clock.hear(THEN - 1)
    assert jumps[1:] == [(THEN + 5, THEN - 1)]
    registration.close()
    clock.hear(THEN - 2)
    assert len(jumps) == 2


@pytest.mark.anyio
async def test_what_arrives_before_the_first_time_of_a_simulation_stays_and_nothing_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    clock = ReplayClock()
    with Bus(clock) as bus, Buffer(bus) as buffer:
        assert not clock.is_set
        bus.publish(moving("odom", "base", 100 * SECOND))
        for second in (100, 101):
            clock.hear(second * SECOND)
        assert clock.is_set
        assert buffer.lookup_nowait("odom", "base").stamp == 100 * SECOND
        assert (bus.statistics().clock_resets, bus.statistics().behind, caplog.records) == (0, 0, [])
        bus.publish(moving("odom", "base", 101))
        assert bus.statistics().behind == 1
        clock.hear(50 * SECOND)
        assert bus.statistics().clock_resets == 1


@pytest.mark.anyio
async def test_sleep_until_waits_for_the_time_that_is_told() -> None:
    clock = ReplayClock()
    await clock.sleep_until(clock.now() + SECOND // 1_000)
    clock.hear(THEN)
    ended: list[str] = []

    async def sleep() -> None:
        try:
            await clock.sleep_until(THEN + SECOND)
        except ClockResetError:
            ended.append("reset")
        else:
            ended.append("reached")

    for last, result in ((THEN + SECOND, "reached"), (THEN - 1, "reset")):
        async with anyio.create_task_group() as tasks:
            clock.hear(THEN)
            tasks.start_soon(sleep)
            await settle()
            clock.hear(THEN + 7)
            await settle()
            clock.hear(last)
        assert ended.pop() == result


def test_a_place_of_ros_is_told_from_a_domain() -> None:
    assert all(map(is_ros, ("dds", "dds:42", "ws://a:9090", "wss://a", "zenoh:robot:7447")))
    assert not any(map(is_ros, ("zenoh:robot", "tf", "dds/a", "adds", "domain:dds")))


@pytest.mark.parametrize(
    ("extra", "place", "what", "value"),
    [
        ("cyclonedds", "dds", "domain", 5),
        ("cyclonedds", "dds:42", "domain", 42),
        ("zenoh", "zenoh:robot:7447", "domain", 5),
        ("wsproto", "ws://robot:9091", "url", "ws://robot:9091"),
    ],
)
def test_a_place_becomes_a_link(
    extra: str, place: str, what: str, value: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(extra)
    monkeypatch.setenv("ROS_DOMAIN_ID", "5")
    assert getattr(ros_link(Bus(), place), what, None) == value


@pytest.mark.parametrize(
    ("place", "why"),
    [("tf", "not a place of ROS: write dds"), ("dds:x", "not a place"), ("dds:300", "0 to 232"), ("ws://", "no URL")],
)
def test_what_is_no_place_of_ros_is_a_usage_error(place: str, why: str) -> None:
    for extra in ("cyclonedds", "wsproto"):
        pytest.importorskip(extra)
    with pytest.raises(UsageError, match=why):
        ros_link(Bus(), place)


def test_the_topics_and_the_prefix_of_a_robot_in_a_namespace_are_given_to_every_place() -> None:
    pytest.importorskip("cyclonedds")
    from support.dds import DdsNode
    from support.joint_messages import odometry

    from tfbus.links.dds.types import RawOdometry

    domain_number = new_dds_domain()
    options = LinkOptions(ros=(f"dds:{domain_number}",), tf=("/robot1/tf",), tf_prefix="robot1/")
    options = replace(options, odometry=("/visual/odom",), invert=True)
    odom = RawOdometry.__idl__.deserialize(odometry(moving("visual", "base", SECOND, 2.0)))

    async def hear(bus: Bus) -> set[str]:
        with Buffer(bus) as buffer, DdsNode(domain_number) as node:
            node.say(static("base", "laser"), topic="rt/robot1/tf_static")
            node.writer("rt/robot1/tf")
            await buffer.lookup("robot1/base", "robot1/laser", timeout=PATIENCE)
            # The moving ones are not latched.
            while not buffer.can_transform("robot1/map", "robot1/visual"):
                node.writer("rt/visual/odom", RawOdometry).write(odom)
                node.say(moving("map", "base", SECOND), topic="rt/robot1/tf")
                node.say(moving("map", "other", SECOND), topic="rt/tf")
                await anyio.sleep(0.02)
            assert buffer.tree.parent("robot1/visual") == "robot1/base"
            return set(buffer.tree.frames())

    assert options.run(hear) == {"robot1/map", "robot1/base", "robot1/laser", "robot1/visual"}
    for wrong, why in (
        (LinkOptions(odometry=("/odom",)), "--odometry is for ROS"),
        (replace(options, odometry=()), "--invert is for the topics of --odometry"),
        (replace(options, odometry=("/pose=camera",)), "--odometry /pose=camera: poses are read from recordings only"),
    ):
        with pytest.raises(UsageError, match=why):
            join(wrong)
    for wrong in (LinkOptions(tf=("/a/tf",)), LinkOptions(tf_prefix="a/")):
        with pytest.raises(UsageError, match="--tf, --tf-prefix and --ros-offset are for ROS"):
            join(wrong)
    with pytest.raises(UsageError, match="cannot be the name of a topic"):
        join(replace(options, tf=("/a b/tf",)))


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "backend"), [("domain", "asyncio"), ("ros", "trio")])
def test_programs_of_all_commands_meet_on_a_domain_and_on_ros(tmp_path: Path, kind: str, backend: str) -> None:
    for extra in ("cyclonedds", "urdf_parser_py"):
        pytest.importorskip(extra)
    number = 100 + os.getpid() % 99
    names = (new_domain(), new_domain()) if kind == "domain" else (f"dds:{number}", f"dds:{number + 1}")
    here, there = ((f"--{kind}", name, "--backend", backend) for name in names)
    place, other = (f"domain {name!r}" if kind == "domain" else f"ROS at {name}" for name in names)
    recording, urdf = str(tmp_path / "drive.mcap"), tmp_path / "arm.urdf"
    urdf.write_text(URDF)
    with (
        start_tfbus("broadcast", *here) as broadcast,
        start_tfbus("static", "base_laser", "camera", "--xyz", "1", "0", "0", *here),
        start_tfbus("robot", str(urdf), *here) as robot,
        start_tfbus("listen", *here) as listen,
    ):
        assert broadcast.errors.expect("broadcasting").endswith(f"on {place}, until Ctrl-C")
        assert "base_link" in listen.output.expect("base_laser")
        assert f"on {place}" in robot.errors.expect("publishing")
        with (
            start_tfbus("echo", "base_link", "camera", *here) as echo,
            start_tfbus("record", recording, *here) as record,
        ):
            echo.output.expect("Translation")
            record.errors.expect(f"recording {place}")
            with start_tfbus("tree", *here) as tree:
                assert tree.wait() == 0
            assert {"base_laser", "camera", "hand"} <= set(re.findall(r"\w+", tree.output.text))
            assert record.end() == 130
    with start_tfbus("echo", "base_link", "camera", *there) as echo, start_tfbus("play", recording, *there) as play:
        play.errors.expect(f"on {other}")
        echo.output.expect("Translation")


@pytest.mark.anyio
async def test_a_refused_frame_is_shown_once_and_published_when_its_place_is_free(
    capsys: pytest.CaptureFixture[str],
) -> None:
    clock = SimulatedClock()
    with Bus(clock) as bus:
        bus.publish(moving("laser", "base", 0, authority="stranger"))

        async def free_and_publish() -> None:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(publish_static, bus, [static("base", "laser"), static("base", "arm")])
                await clock.sleep(2.5)
                bus.remove_frame("base")

        await simulate(clock, free_and_publish)
        assert bus.statistics().frames == 2
    errors = capsys.readouterr().err
    assert errors.count("refused, and tried again once a second: the edge 'base' -> 'laser' would close a loop") == 1
    assert clock.now() == 3_000_000_000

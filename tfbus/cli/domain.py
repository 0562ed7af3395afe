"""Joining a domain, or ROS: the options that say how, and the program that runs on the joined bus.

`LinkOptions` are the options of every command that joins; `LinkOptions.run` makes a bus, links it to the domain or by
`ros_link` to the places of ROS, and has `run` run the program on it in an event loop that ends in order at Ctrl-C. The
bus of a command that shows times has a `ReplayClock`, which follows the time that a replay tells the domain.
"""

import os
import re
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, TypeVar

from cyclopts import Group, Parameter

from tfbus.cli.arguments import Backend, Flag, UsageError, usage_errors
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import print_now, say, warn

with lazy_imports():
    import anyio
    from anyio.abc import TaskStatus

    from tfbus.bus.bus import Bus
    from tfbus.cli.replay_clock import ReplayClock
    from tfbus.clock import Clock, SimulatedClock
    from tfbus.errors import InvalidTransformError, pip_install
    from tfbus.geometry.stamped import TransformStamped
    from tfbus.links.bus_server import BusServer
    from tfbus.links.domain import DomainOptions
    from tfbus.links.link import DomainLink, Link
    from tfbus.links.local import LocalLink

T = TypeVar("T")

_DDS = re.compile(r"dds(?::(\d{1,3}))?")
_ZENOH = re.compile(r"zenoh:(.+:\d+)")
_WEBSOCKET = re.compile(r"wss?://.*")
_RETRY = 1.0
"""The time between two attempts, in s."""
_SILENCE_BEFORE_NOTICE = 1.0
"""s."""


class RemoteLookups(Protocol):
    """The part of a `tfbus.Buffer` that commands ask in other programs, too."""

    async def lookup(
        self,
        target: str,
        source: str,
        /,
        *,
        timeout: float | None = None,
        max_age: float | None = None,
    ) -> TransformStamped:
        """The transform in the other buffer."""


@dataclass(frozen=True, slots=True)
class _RobotLookups:
    """Lookups in the buffer of one robot."""

    link: DomainLink
    robot: str | None

    async def lookup(
        self, target: str, source: str, /, *, timeout: float | None = None, max_age: float | None = None
    ) -> TransformStamped:
        return await self.link.lookup(target, source, robot=self.robot, timeout=timeout, max_age=max_age)


@Parameter(name="*", group=Group("How to join", sort_key=5))
@dataclass(frozen=True, slots=True)
class LinkOptions:
    """The options of a command that joins a domain.

    Parameters
    ----------
    domain
        Only programs of the same domain hear each other.
    listen
        Run a router in this program that listens at this address, such as tcp/192.168.1.5:7447; may be given several
        times. Without any address, programs on this machine find each other by themselves.
    connect
        Connect to the router at this address; may be given several times, for routers that are tried in turn.
    robot
        The robot whose frames this program publishes.
    robots
        Hear only these robots, such as r1 or r*; may be given several times.
    ros
        Join ROS in place of a domain: dds for ROS 2, dds:42 if its ROS_DOMAIN_ID is 42, zenoh:host:7447 for a router
        of rmw_zenoh, or ws://host:9090 for a rosbridge server of ROS 1 or ROS 2; may be given several times.
    tf
        With --ros, the topic of a robot in a namespace, such as /robot1/tf; its static frames are on /robot1/tf_static.
        May be given several times.
    tf_prefix
        With --ros, a prefix for the names of all frames that come from there, such as robot1/.
    ros_offset
        With --ros, seconds that are added to each stamp that comes from there, such as -0.3 for a robot whose clock is
        0.3 s ahead.
    backend
        The event loop to run on.
    """

    domain: Annotated[str, Parameter(env_var="TFBUS_DOMAIN")] = "tf"
    listen: tuple[str, ...] = ()
    connect: Annotated[tuple[str, ...], Parameter(env_var="TFBUS_CONNECT")] = ()
    robot: str | None = None
    robots: tuple[str, ...] = ()
    ros: tuple[str, ...] = ()
    tf: tuple[str, ...] = ()
    tf_prefix: str | None = None
    ros_offset: float = 0.0
    backend: Backend = "asyncio"
    # Options of `HearingOptions`, or of the command itself.
    odometry: Annotated[tuple[str, ...], Parameter(parse=False)] = ()
    invert: Annotated[Flag, Parameter(parse=False)] = False
    correct_clocks: Annotated[Flag, Parameter(parse=False)] = False

    @property
    def place(self) -> str:
        """The place that is joined, in words."""
        return f"ROS at {' and '.join(self.ros)}" if self.ros else f"domain {self.domain!r}"

    @property
    def route(self) -> str:
        """The route to other programs, in words."""
        if self.ros:
            return f"in {self.place}"
        if self.listen:
            return f"by the router of this program at {' and '.join(self.listen)}"
        return f"by a router at {' or '.join(self.connect)}" if self.connect else "on this machine"

    def run(
        self, program: Callable[[Bus], Awaitable[T]], *, clock: Clock | None = None, links: list[Link] | None = None
    ) -> T:
        """Run a program on a bus that has joined the domain, until its end or Ctrl-C.

        Parameters
        ----------
        program : async callable
        clock : Clock, optional
            The clock of the bus. The domain is told the time of a `SimulatedClock`; a `ReplayClock` follows the time of
            the domain.
        links : list, optional
            Is given the links of the bus before the program begins.

        Returns
        -------
        The result of the program.

        Raises
        ------
        UsageError
            If the domain cannot be joined.
        KeyboardInterrupt
            After everything has ended, if Ctrl-C was pressed.
        """

        async def join_and_run() -> T:
            with Bus(clock) as bus:
                async with self.join(bus) as joined:
                    if links is not None:
                        links.extend(joined)
                    return await program(bus)

        return run(join_and_run, self.backend)

    def serve(self, server_of: Callable[[Bus], BusServer], hint: str) -> None:
        """Run a server of the joined bus until Ctrl-C; its address is printed, and the hint, which may have a {place}.

        Raises
        ------
        UsageError
            If the server cannot be made, or cannot listen at its address.
        """

        async def serve(bus: Bus) -> None:
            with usage_errors():
                server = server_of(bus)
            try:
                await server.__aenter__()
            except OSError as error:
                raise UsageError(str(error)) from None
            try:
                print_now(server.address)
                say(hint.format(place=server.address.removeprefix("ws://")))
                await anyio.sleep_forever()
            finally:
                await server.__aexit__(None, None, None)

        self.run(serve)

    @asynccontextmanager
    async def join(self, bus: Bus) -> AsyncIterator[Sequence[Link]]:
        """Link a bus to the domain, or to ROS, for the body of an ``async with``, which is given the links.

        Raises
        ------
        UsageError
            If an option is not valid, an address cannot be listened at or reached, or the extra is missing.
        """
        follower = bus.clock if isinstance(bus.clock, ReplayClock) else None
        if not self.ros and (self.tf or self.tf_prefix is not None or self.ros_offset):
            raise UsageError("--tf, --tf-prefix and --ros-offset are for ROS: give --ros, such as --ros dds")
        if not self.ros and self.odometry:
            raise UsageError("--odometry is for ROS: give --ros, such as --ros dds")
        if self.invert and not self.odometry:
            raise UsageError("--invert is for the topics of --odometry: give one")
        if self.ros and self.correct_clocks:
            raise UsageError("--correct-clocks is for a domain: ROS tells no clocks, give --ros-offset")
        if self.ros:
            async with AsyncExitStack() as stack:
                links = []
                for place in self.ros:
                    try:
                        links.append(await stack.enter_async_context(self.ros_link(bus, place, clock=follower)))
                    except OSError as error:
                        why = os.strerror(error.errno) if error.errno else error
                        raise UsageError(f"cannot join ROS at {place}: {why}") from None
                yield links
            return
        options: DomainOptions = {
            "robot": self.robot,
            "robots": self.robots or None,
            "clock": follower,
            "tell_clock": isinstance(bus.clock, SimulatedClock),
            "correct_clocks": self.correct_clocks,
        }
        async with self._entered(bus, options) as link:
            yield [link]

    def ros_link(self, bus: Bus, place: str, **options: Any) -> Link:
        """The link to a place of ROS, with the topics and the prefix of the options; raises `UsageError`."""
        if self.tf:
            namespace = self.tf[0].rpartition("/")[0]
            topics = {"joint_topic": "joint_states", "description_topic": "robot_description"}
            options |= {option: f"{namespace}/{topic}" for option, topic in topics.items()}
            options |= {"tf": self.tf, "tf_static": [f"{topic}_static" for topic in self.tf]}
        for topic in self.odometry:
            if "=" in topic:
                raise UsageError(f"--odometry {topic}: poses are read from recordings only, odometry from ROS too")
        if self.odometry:
            options |= {"odometry": self.odometry, "invert": self.invert}
        return ros_link(bus, place, prefix=self.tf_prefix, offset=self.ros_offset, **options)

    def run_remote(self, program: Callable[[RemoteLookups], Awaitable[T]]) -> T:
        """Run a program that asks the buffer of the robot in `robots`, in another process, until its end.

        Raises
        ------
        UsageError
            If `robots` names several robots, or the domain cannot be joined.
        KeyboardInterrupt
            After everything has ended, if Ctrl-C was pressed.
        """
        if len(self.robots) > 1:
            raise UsageError("--remote asks the buffer of one robot: give --robots once")
        if self.correct_clocks:
            raise UsageError("--correct-clocks moves stamps as they arrive: with --remote, the other program answers")
        # With the rate 0, the link learns who is there and receives no transforms.
        options: DomainOptions = {"robots": dict.fromkeys(self.robots or ("*",), 0.0)}

        async def enter_and_run() -> T:
            async with self._entered(Bus(), options) as remote:
                return await program(_RobotLookups(remote, self.robots[0] if self.robots else None))

        return run(enter_and_run, self.backend)

    @asynccontextmanager
    async def _entered(self, bus: Bus, options: DomainOptions) -> AsyncIterator[DomainLink]:
        """Make and enter a link to the domain for the body of an ``async with``."""
        async with AsyncExitStack() as stack:
            try:
                link = await stack.enter_async_context(self._link(bus, options))
            except ValueError as error:
                raise UsageError(str(error)) from None
            except OSError as error:
                why = os.strerror(error.errno) if error.errno else error
                failed = f"cannot listen at {' or '.join(self.listen)}" if self.listen else "cannot join the domain"
                raise UsageError(f"{failed}: {why}") from None
            yield link

    def _link(self, bus: Bus, options: DomainOptions) -> DomainLink:
        """The link that the options ask for: on this machine, or by a router."""
        if not self.listen and not self.connect:
            return LocalLink(bus, self.domain, **options)
        try:
            from tfbus.links.zenoh import ZenohLink
        except ImportError:
            raise UsageError(f"--connect and --listen need one more package: {pip_install('cli,zenoh')}") from None
        return ZenohLink(bus, self.domain, listen=self.listen or None, connect=self.connect or None, **options)

    async def first_transform(self, bus: Bus, links: Sequence[Link] = ()) -> None:
        """Wait until something is published on the bus, with a notice if that takes more than a second."""
        arrived = anyio.Event()
        with bus.subscribe(lambda _: arrived.set()):
            with bus.clock.move_on_after(_SILENCE_BEFORE_NOTICE):
                await arrived.wait()
                return
            say(f"waiting for transforms on {self.place} …")
            self.print_peers(links)
            await arrived.wait()

    def print_peers(self, links: Sequence[Link]) -> None:
        """Print how many peers the links have, and how they are reached; nothing without a link."""
        if links:
            peers = sum(len(link.peers) for link in links)
            say(f"hears {'nobody' if not peers else '1 peer' if peers == 1 else f'{peers:,} peers'} {self.route}")


@Parameter(name="*", group=Group("How to join", sort_key=5))
@dataclass(frozen=True, slots=True)
class HearingOptions(LinkOptions):
    """The options of a command that joins a domain to hear it.

    Parameters
    ----------
    odometry
        With --ros, a topic of nav_msgs/Odometry whose poses are transforms too; may be given several times.
    invert
        Make the child of the odometry the parent, because it has a parent already.
    correct_clocks
        Move the stamps of other programs to the clock of this machine, by the offsets that the link measures.
    """

    odometry: tuple[str, ...] = ()
    invert: Flag = False
    correct_clocks: Flag = False


DEFAULT_LINK = LinkOptions()
DEFAULT_HEARING = HearingOptions()
"""The options of a command line that gives none."""


def run(main: Callable[[], Awaitable[T]], backend: str) -> T:
    """Run an async function as `anyio.run` does; Ctrl-C cancels it, and its cleanup survives further presses.

    Raises
    ------
    KeyboardInterrupt
        After the function has ended, if Ctrl-C was pressed.
    """
    # A handler that is not Python's own stays: a shell, for example, has background programs ignore the signal.
    if sys.platform == "win32" or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return anyio.run(main, backend=backend)
    interrupted = False
    failure: Exception | None = None
    result: T

    async def run_until_interrupted() -> None:
        nonlocal interrupted
        with anyio.open_signal_receiver(signal.SIGINT) as presses:
            async with anyio.create_task_group() as tasks:

                async def work() -> None:
                    nonlocal failure, result
                    try:
                        result = await main()
                    except Exception as error:  # noqa: BLE001 - the task group would wrap it in an ExceptionGroup
                        failure = error
                    tasks.cancel_scope.cancel()

                tasks.start_soon(work)
                async for _ in presses:
                    interrupted = True
                    tasks.cancel_scope.cancel()

    anyio.run(run_until_interrupted, backend=backend)
    if failure is not None:
        raise failure
    if interrupted:
        raise KeyboardInterrupt
    return result


def is_ros(place: str) -> bool:
    """Whether a place is one of ROS rather than a domain."""
    return any(kind.fullmatch(place) for kind in (_DDS, _ZENOH, _WEBSOCKET))


def ros_link(bus: Bus, place: str, **options: Any) -> Link:
    """The link to a place: ``dds``, ``dds:42``, ``zenoh:host:7447`` or ``ws://host:9090``.

    Parameters
    ----------
    bus : Bus
    place : str
    **options
        The options that all links to ROS share.

    Raises
    ------
    UsageError
        If it is none of these, or an extra is missing.
    """
    with usage_errors():
        if found := _DDS.fullmatch(place):
            from tfbus.links.dds import DdsLink

            return DdsLink(bus, None if found[1] is None else int(found[1]), **options)
        if found := _ZENOH.fullmatch(place):
            from tfbus.links.rmw_zenoh import RmwZenohLink

            return RmwZenohLink(bus, f"tcp/{found[1]}", **options)
        if _WEBSOCKET.fullmatch(place):
            from tfbus.links.rosbridge import RosbridgeLink

            return RosbridgeLink(bus, place, **options)
    raise UsageError(
        f"{place!r} is not a place of ROS: write dds, dds:42 for ROS_DOMAIN_ID 42, zenoh:host:7447, or ws://host:9090"
    )


async def publish_static(
    bus: Bus, samples: Sequence[TransformStamped], *, task_status: TaskStatus[None] | None = None
) -> None:
    """Publish static samples; a refused sample is shown once, and tried again until it is accepted.

    A refused sample may close a loop with an edge of another program, and that program may end. As a task, it has
    started once each sample has been tried.
    """
    warned: set[str] = set()
    pending = _publish_each(bus, samples, warned)
    if task_status is not None:
        task_status.started()
    while pending:
        await bus.clock.sleep(_RETRY)
        pending = _publish_each(bus, pending, warned)


def _publish_each(bus: Bus, samples: Sequence[TransformStamped], warned: set[str]) -> list[TransformStamped]:
    """Publish samples one by one, and return the samples that the bus refused."""
    refused = []
    for sample in samples:
        try:
            bus.publish(sample)
        except InvalidTransformError as error:
            refused.append(sample)
            if sample.child not in warned:
                warned.add(sample.child)
                warn(f"refused, and tried again once a second: {error}")
    return refused

"""Joining a domain: the options that say how, and the program that runs on the joined bus."""

import os
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Annotated, Protocol, TypeVar

import anyio
from cyclopts import Parameter

from tfbus.bus.bus import Bus
from tfbus.cli._event_loop import run
from tfbus.cli._replay_clock import ReplayClock
from tfbus.cli._ros import ros_link
from tfbus.cli.arguments import Backend, UsageError
from tfbus.cli.output import say
from tfbus.clock import Clock, SimulatedClock
from tfbus.errors import pip_install
from tfbus.geometry.stamped import TransformStamped

T = TypeVar("T")

_SILENCE_BEFORE_NOTICE = 1.0
"""s."""
_NO_ZENOH = f"joining a domain needs a package more: {pip_install('cli,zenoh')}"


class RemoteLookups(Protocol):
    """The part of a `tfbus.links.zenoh.BufferClient` that commands use; the extra may be missing."""

    async def lookup(
        self, target: str, source: str, /, *, timeout: float | None = None, max_age: float | None = None
    ) -> TransformStamped:
        """The transform in the other buffer."""


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class LinkOptions:
    """The options of a command that joins a domain.

    Parameters
    ----------
    domain
        Only programs of the same domain hear each other.
    listen
        Listen at this address, such as tcp/192.168.1.5:7447; may be given several times. Without any address, programs
        on this machine find each other by themselves.
    connect
        Connect to a program that listens at this address; may be given several times. Programs without an address
        listen at tcp/127.0.0.1:17447.
    robot
        The robot whose frames this program publishes.
    robots
        Hear only these robots, such as r1 or r*; may be given several times.
    ros
        Join ROS in place of a domain: dds for ROS 2, dds:42 if its ROS_DOMAIN_ID is 42, zenoh:host:7447 for a router
        of rmw_zenoh, or ws://host:9090 for a rosbridge server of ROS 1 or ROS 2; may be given several times.
    backend
        The event loop to run on.
    """

    domain: Annotated[str, Parameter(env_var="TFBUS_DOMAIN")] = "tf"
    listen: tuple[str, ...] = ()
    connect: Annotated[tuple[str, ...], Parameter(env_var="TFBUS_CONNECT")] = ()
    robot: str | None = None
    robots: tuple[str, ...] = ()
    ros: tuple[str, ...] = ()
    backend: Backend = "asyncio"

    @property
    def place(self) -> str:
        """The place that is joined, for people."""
        return f"ROS at {' and '.join(self.ros)}" if self.ros else f"domain {self.domain!r}"

    def run(self, program: Callable[[Bus], Awaitable[T]], *, clock: Clock | None = None) -> T:
        """Run a program on a bus that has joined the domain, until its end or Ctrl-C.

        Parameters
        ----------
        program : async callable
        clock : Clock, optional
            The clock of the bus. The time of a `SimulatedClock` is told to the domain; a `ReplayClock` follows the time
            that is told there.

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
                async with self.join(bus):
                    return await program(bus)

        return run(join_and_run, self.backend)

    @asynccontextmanager
    async def join(self, bus: Bus) -> AsyncIterator[None]:
        """Link a bus to the domain, or to ROS, for the body of an ``async with``.

        Raises
        ------
        UsageError
            If an option is not valid, an address cannot be listened at or reached, or the extra is missing.
        """
        follower = bus.clock if isinstance(bus.clock, ReplayClock) else None
        if self.ros:
            async with AsyncExitStack() as stack:
                for place in self.ros:
                    try:
                        await stack.enter_async_context(ros_link(bus, place, clock=follower))
                    except OSError as error:
                        why = os.strerror(error.errno) if error.errno else error
                        raise UsageError(f"cannot join ROS at {place}: {why}") from None
                yield
            return
        try:
            from tfbus.links.zenoh import ZenohLink
        except ImportError:
            raise UsageError(_NO_ZENOH) from None
        async with self._entered(
            lambda: ZenohLink(
                bus,
                self.domain,
                listen=self.listen or None,
                connect=self.connect or None,
                robot=self.robot,
                robots=self.robots or None,
                clock=follower,
                tell_clock=isinstance(bus.clock, SimulatedClock),
            )
        ):
            yield

    def run_remote(self, program: Callable[[RemoteLookups], Awaitable[T]]) -> T:
        """Run a program that asks the buffer of another program, that of the robot in `robots`, until its end.

        Raises
        ------
        UsageError
            If `robots` names several robots, or the domain cannot be joined.
        KeyboardInterrupt
            After everything has ended, if Ctrl-C was pressed.
        """
        try:
            from tfbus.links.zenoh import BufferClient
        except ImportError:
            raise UsageError(_NO_ZENOH) from None
        if len(self.robots) > 1:
            raise UsageError("--remote asks the buffer of one robot: give --robots once")
        robot = self.robots[0] if self.robots else None

        async def enter_and_run() -> T:
            async with self._entered(
                lambda: BufferClient(self.domain, robot=robot, listen=self.listen or None, connect=self.connect or None)
            ) as remote:
                return await program(remote)

        return run(enter_and_run, self.backend)

    @asynccontextmanager
    async def _entered(self, make: Callable[[], AbstractAsyncContextManager[T]]) -> AsyncIterator[T]:
        """Make and enter an end of the domain for the body of an ``async with``."""
        async with AsyncExitStack() as stack:
            try:
                entered = await stack.enter_async_context(make())
            except ValueError as error:
                raise UsageError(str(error)) from None
            except OSError as error:
                where = " or ".join(self.listen) or "the loopback"
                why = os.strerror(error.errno) if error.errno else error
                raise UsageError(f"cannot listen at {where}: {why}") from None
            yield entered

    async def first_transform(self, bus: Bus) -> None:
        """Wait until something is published on the bus, with a notice if that takes more than a second."""
        arrived = anyio.Event()
        with bus.subscribe(lambda _: arrived.set()):
            with bus.clock.move_on_after(_SILENCE_BEFORE_NOTICE):
                await arrived.wait()
                return
            say(f"waiting for transforms on {self.place} …")
            await arrived.wait()


DEFAULT_LINK = LinkOptions()
"""The options of a command line that gives none."""

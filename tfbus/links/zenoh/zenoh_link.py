"""A link over zenoh: what is published on its bus reaches every other bus of the domain, and the other way round.

`tfbus.links.zenoh._keys` lists the keys. Static frames, removals, and whatever else the network has lost of a link's
state come with the answers to questions; see `tfbus.links._state`.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import zenoh

from tfbus.bus.bus import Bus
from tfbus.clock import SimulatedClock
from tfbus.links._clock_follower import HearsTime
from tfbus.links.link import Link
from tfbus.links.zenoh._carrier import ZenohCarrier
from tfbus.links.zenoh._filters import write_filter
from tfbus.links.zenoh._keys import NO_ROBOT, Keys, check_domain, check_robot, robots_expression
from tfbus.links.zenoh._settings import Addresses, endpoints, identity, patch_settings, settings


class ZenohLink(Link):
    """Joins a bus to every other bus of a domain: ``async with ZenohLink(bus) as link``.

    Samples keep their stamps and authorities, and batches stay whole. Without an address, links find each other on this
    machine only, in whatever order they start, and nothing is opened to a network.

    Parameters
    ----------
    bus : Bus
    domain : str
        Only links of the same domain hear each other; words of letters, digits, ``-``, ``_`` and ``.``, with ``/``
        between them.
    listen, connect : str or iterable of str, optional
        zenoh's endpoints, such as ``tcp/192.168.1.5:7447``: where to listen, and where other links or a router listen.
        Links find each other through the ones that they are connected to, and then talk directly. So of any two links,
        one has to listen where the other can reach it, or be a client, ``config={"mode": "client"}``; the link that a
        client is connected to passes on everything for it. Links without any address meet at ``tcp/127.0.0.1:17447``; a
        link that has an address meets them only if it connects there as well.
    config : mapping of str to any, optional
        Settings of zenoh by their path, laid over those of the link: TLS, access control, routers.
    robot : str, optional
        The robot whose frames this link brings: letters, digits, ``-``, ``_`` and ``.``.
    robots : iterable of str, or mapping of str to float, optional
        Hear only the links of these robots; ``*`` in a name stands for any letters. What others send never leaves their
        machines for this link, and they are no peers of it. By default, it hears all, with and without a robot. A
        mapping gives a rate in Hz for each: of a robot with a finite rate come the static frames and the newest sample
        of each moving one, at most so often, and no more often than its links send that, by their `slow_rate`;
        `math.inf` is for everything.
    slow_rate : float
        How often this link sends the newest sample of each moving frame to those that asked for less than all, in Hz.
    frames : iterable of str, optional
        Send and take only these children; by default all. Peers send this link no moving samples of others, but for
        those that it hears by a rate, while the names take less than 12 kB and a peer has at most a hundred different
        filters to serve.
    drop_lost : bool
        Whether the frames of a peer leave the bus when it is lost, those that it was the last to publish.
    lease : float, optional
        Seconds of silence after which others take this link for lost, when it is frozen or cut off, and it takes them
        for lost by theirs; a process that dies is lost at once. Two signs of life go out in each lease, so to be held
        up for less than half of it loses nobody. By default, it is 4 s, or 10 s where the machine is busy when the link
        is made: under Linux, if more than eight threads for each CPU run or could run.
    max_frames : int
        How many frames one peer may have; samples of others are refused and counted.
    capacity : int
        How many live messages may wait for the event loop; then the oldest are dropped and counted.
    history : float, optional
        Ask each peer once, when it is met, for the last so many seconds of its moving frames, as far as buffers on its
        bus hold them: 2,000 samples of each frame at most. They are published before what it sends live, so lookups at
        stamps before the joining can be answered.
    clock : SimulatedClock, optional
        Follows the time that a peer tells: it advances, and jumps where that time jumps. The first peer that tells a
        time is followed until it is lost; the time of others is refused and counted.
    tell_clock : bool
        Whether to tell peers the time of the bus's clock, which is a `SimulatedClock`.

    Attributes
    ----------
    bus : Bus
    domain : str
    robot : str or None
    id : str
        The name of this end for its peers.

    Raises
    ------
    ValueError
        If `domain` or the name of a robot cannot be part of a key, a number is out of range, or zenoh does not take an
        address or a setting.
    TypeError
        If `frames` or `robots` is one name, or a number or an address is of another type.
    OSError
        On entering, if it cannot listen where it should, or as a client reaches nobody.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the link was entered before.
    ImportError
        On import, without the extra: ``pip install "tfbus[zenoh]"``.

    Notes
    -----
    Nothing here blocks the event loop: while the network is congested, live messages are dropped, which the other end
    counts as `lost`. Static frames and removals are recovered: each link numbers what it brings and what it has
    removed, tells the number with every message, and now and then when it has nothing else to tell; whoever has missed
    something asks for it. A peer whose connection breaks is dialled again where it was reached before. Anyone who can
    reach the link can publish and remove any frame.
    """

    def __init__(
        self,
        bus: Bus,
        domain: str = "tf",
        *,
        listen: Addresses | None = None,
        connect: Addresses | None = None,
        config: Mapping[str, Any] | None = None,
        robot: str | None = None,
        robots: Iterable[str] | Mapping[str, float] | None = None,
        slow_rate: float = 1.0,
        frames: Iterable[str] | None = None,
        drop_lost: bool = False,
        lease: float | None = None,
        max_frames: int = 10_000,
        capacity: int = 10_000,
        history: float | None = None,
        clock: SimulatedClock | HearsTime | None = None,
        tell_clock: bool = False,
    ) -> None:
        if isinstance(robots, str):
            raise TypeError(f"robots must be several names, not {robots!r}")
        rates = robots if isinstance(robots, Mapping) else dict.fromkeys(("*",) if robots is None else robots, math.inf)
        for rate in (*rates.values(), slow_rate):
            # Not a number is not greater either.
            if not rate > 0:
                raise ValueError(f"a rate must be greater than zero, got {rate!r} Hz")
        if slow_rate == math.inf:
            raise ValueError("slow_rate must be finite")
        heard = {robots_expression(robot): rate for robot, rate in rates.items()}
        in_full = tuple(robot for robot, rate in heard.items() if rate == math.inf)
        # One name is refused below.
        chosen = frames if frames is None or isinstance(frames, str) else frozenset(frames)
        self.domain = check_domain(domain)
        self.robot = robot
        listen, connect = (None if given is None else endpoints(given) for given in (listen, connect))
        # Peers tell by the id of a session at which address they have reached a link.
        its_own = identity(listen, connect, config)
        link, own = its_own["id"], {**its_own, **(config or {})}
        carrier = ZenohCarrier(
            settings(listen, connect, own, lease),
            lambda address: patch_settings(address, config, lease),
            Keys(
                domain,
                link,
                NO_ROBOT if robot is None else check_robot(robot),
                in_full,
                tuple((robot, rate) for robot, rate in heard.items() if rate < math.inf),
                "" if chosen is None or not in_full else write_filter(in_full, chosen),
            ),
            slow_rate,
        )
        super().__init__(
            bus,
            domain,
            carrier,
            frames=chosen,
            drop_lost=drop_lost,
            max_frames=max_frames,
            capacity=capacity,
            history=history,
            clock=clock,
            tell_clock=tell_clock,
        )
        self._zenoh = carrier

    def _zenoh_session(self) -> zenoh.Session:
        """The session of zenoh; raises `RuntimeError` unless the link is entered."""
        if not self._attached:
            raise RuntimeError("the link is not entered")
        return self._zenoh.session

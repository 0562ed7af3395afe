"""A random life of a network of links: steps given by numbers, and checks for the end."""

from itertools import combinations

from hypothesis import strategies as st
from support.samples import moving, static
from support.wires import Network, latched

from tfbus import Bus, TransformStamped
from tfbus.links._receive_queue import Presence

Step = tuple[str, int, int, list[int]]
"""A kind of step, the number of a bus, the number of a place, and some more numbers."""


def frames_of(bus: Bus) -> set[str]:
    """The children that a bus knows now: those of the events that a new reader would get."""
    with bus.events() as events:
        return {event.frame for event in iter(events.queue.get, None) if hasattr(event, "frame")}


def steps_of(*more: str) -> st.SearchStrategy[list[Step]]:
    """Short and long lists of steps; `more` are kinds of steps besides the usual ones."""
    kinds = ("publish", "publish", "remove", "send", "send", "deliver", "deliver", "deliver", *more)
    number = st.integers(0, 11)
    step = st.tuples(st.sampled_from(kinds), number, number, st.lists(number, min_size=1, max_size=4))
    return st.lists(step, max_size=10) | st.lists(step, min_size=30, max_size=80)


class Model:
    """Drives a network by steps; each bus has three frames of its own, and all share one."""

    def __init__(self, net: Network) -> None:
        self.net = net
        self._stamp = 0
        self._frozen: set[Bus] = set()

    def do(self, step: str, who: int, where: int, numbers: list[int]) -> None:
        net = self.net
        bus = net.buses[who % len(net.buses)]
        wires = net.wires
        if step == "publish":
            bus.publish([self._sample(who % len(net.buses), number) for number in numbers])
        elif step == "remove":
            if f"{who % len(net.buses)}.{where % 3}" in frames_of(bus):
                bus.remove_frame(f"{who % len(net.buses)}.{where % 3}")
        elif step == "takeover":
            # Buses agree on the last publisher only if no two publish at once.
            net.settle()
            self._stamp += 1
            bus.publish((static if where % 2 else moving)("map", "shared", stamp=self._stamp, x=float(self._stamp)))
            net.settle()
        elif step == "contend":
            self._stamp += 1
            bus.publish(static("map", "contended", stamp=self._stamp, x=float(self._stamp)))
        elif step == "freeze":
            self._frozen.symmetric_difference_update({bus})
        elif step == "expel":
            if frames := sorted(frames_of(bus)):
                bus.remove_frame(frames[where % len(frames)])
        elif step == "banish":
            net.settle()
            if frames := sorted(frames_of(bus)):
                bus.remove_frame(frames[where % len(frames)])
            net.settle()
        elif step == "send":
            net.send(bus)
        elif step == "join":
            net.domains[where % len(net.domains)].join(net.add_bus())
        elif step in ("part", "meet"):
            domain = net.domains[where % len(net.domains)]
            one, other = domain.ends[who % len(domain.ends)], domain.ends[numbers[0] % len(domain.ends)]
            if one is not other and ((one, other) in domain.wires) == (step == "part"):
                (domain.part if step == "part" else domain.meet)(one, other)
        elif step == "flush":
            for wire in wires:
                while wire.packets:
                    wire.deliver()
        elif wires:
            wire = wires[where % len(wires)]
            place = numbers[0] % len(wire.packets)
            if step in ("deliver", "overtake"):
                if wire.receiver.bus not in self._frozen:
                    wire.deliver(place if step == "overtake" else 0)
            elif isinstance(wire.packets[place], Presence):
                # The network tells for sure who is there.
                return
            elif step == "drop":
                del wire.packets[place]
            elif step == "repeat":
                wire.packets.append(wire.packets[place])

    def live(self, steps: list[Step]) -> None:
        """Do all steps, have all peers meet again and receive what they missed, and check that all buses agree."""
        for step in steps:
            self.do(*step)
        for domain in self.net.domains:
            for one, other in combinations(domain.ends, 2):
                if (one, other) not in domain.wires:
                    domain.meet(one, other)
        self.net.settle()
        self.net.recover()
        self.check_nothing_went_wrong()
        self.check_nothing_older_came(say_again=True)
        self.check_no_echo()
        self.move_on()
        self.check_all_agree()

    def _sample(self, member: int, number: int) -> TransformStamped:
        self._stamp += 1
        kind = static if number % 4 == 3 else moving
        parent, child = ("map", "odom")[number % 2], f"{member}.{number % 3}"
        return kind(parent, child, stamp=self._stamp, x=float(self._stamp), authority=("", "slam")[number // 6])

    def move_on(self) -> None:
        """Publish all frames that have turned moving once more, so that every bus hears of the change."""
        for member, bus in enumerate(self.net.buses):
            for frame in sorted(frames_of(bus) - latched(bus).keys()):
                if frame.startswith(f"{member}."):
                    bus.publish(moving("map", frame, 10**9))
        self.net.settle()

    def check_nothing_went_wrong(self) -> None:
        for bus in self.net.buses:
            assert bus.statistics().callbacks_failed == 0
            assert bus.statistics().rejected == {}
        for end in self.net.ends:
            assert (end.carrier.refused, end.endpoint.peers.rejected) == ([], {})

    def check_nothing_older_came(self, say_again: bool = False) -> None:
        """Check that each bus has heard ever newer samples of each frame."""
        for heard in self.net.heard:
            newest: dict[str, int] = {}
            for batch in heard:
                last = {sample.child: sample.stamp for sample in batch if sample.child != "contended"}
                for child, stamp in last.items():
                    known = newest.get(child, -1)
                    assert stamp > known or (say_again and stamp == known)
                newest |= last

    def check_no_echo(self) -> None:
        for member, heard in enumerate(self.net.heard):
            for batch in heard:
                own = [sample.child.startswith(f"{member}.") for sample in batch if sample.child != "contended"]
                assert all(own) if type(batch[0]) is TransformStamped else not any(own)

    def check_all_agree(self) -> None:
        """Check that all buses have the same frames, and the same static samples."""
        first = self.net.buses[0]
        for other in self.net.buses[1:]:
            assert frames_of(other) == frames_of(first)
            assert latched(other) == latched(first)

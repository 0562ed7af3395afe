"""The DDS domains of this process, and their configuration.

The library has one domain of a number in a process, with one configuration. So links to the same domain share it, and
the last of them that ends deletes it.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Literal
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain

Discovery = Literal["localhost", "subnet"]

_FAST_DDS = "1.15"
_PARTICIPANTS = 32
"""So many on one machine are found; as many as ROS 2 looks for by default."""

# Fast DDS 3 sends type information that Cyclone DDS takes for malformed, and then refuses to talk.
_COMPATIBILITY = f"<Compatibility><IgnoreTypeInformation>{_FAST_DDS}</IgnoreTypeInformation></Compatibility>"
_LOOPBACK = (
    '<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General>"
)


def configuration(discovery: Discovery, peers: Iterable[str], own: str | None) -> str:
    """The configuration of Cyclone DDS, as its documentation describes it.

    Parameters
    ----------
    discovery : {"localhost", "subnet"}
        Where others are looked for.
    peers : iterable of str
        Further machines to look at.
    own : str or None
        A configuration in place of the two, XML or the URL of a file.
    """
    if own is not None:
        return f'{own},<CycloneDDS><Domain id="any">{_COMPATIBILITY}</Domain></CycloneDDS>'
    machines = (*(("127.0.0.1",) if discovery == "localhost" else ()), *peers)
    addresses = "".join(f"<Peer address={quoteattr(machine)}/>" for machine in machines)
    found = (
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{_PARTICIPANTS}</MaxAutoParticipantIndex>"
        f"{f'<Peers>{addresses}</Peers>' if addresses else ''}</Discovery>"
    )
    network = _LOOPBACK if discovery == "localhost" else ""
    return f'<CycloneDDS><Domain id="any">{network}{found}{_COMPATIBILITY}</Domain></CycloneDDS>'


class _SharedDomain:
    def __init__(self, number: int, config: str) -> None:
        self.config = config
        self.users = 0
        self.domain = Domain(number, config)


_lock = Lock()
_open: dict[int, _SharedDomain] = {}


@contextmanager
def domain(number: int, config: str) -> Iterator[None]:
    """Have a domain open with a configuration.

    Raises
    ------
    OSError
        If it cannot be opened, or is open in this process with another configuration.
    """
    with _lock:
        shared = _open.get(number)
        if shared is None:
            try:
                shared = _open[number] = _SharedDomain(number, config)
            except DDSException as error:
                raise OSError(f"cannot open the DDS domain {number}: {error}") from None
        elif shared.config != config:
            raise OSError(f"the DDS domain {number} is open in this process with another configuration")
        shared.users += 1
    try:
        yield
    finally:
        with _lock:
            shared.users -= 1
            if not shared.users:
                del _open[number]
                shared.domain.__del__()

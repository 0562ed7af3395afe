"""The deviations of tfbus from Debian's tf2, each with its reason: the guide's table says what each side does.

``ros2`` means that ROS 1 and ROS 2 differ and tfbus does as ROS 2; ``design`` that neither is followed.
"""

from typing import NamedTuple


class Deviation(NamedTuple):
    """On whose word, and why."""

    expected_by: str
    reason: str


DEVIATIONS = {
    "same stamp": Deviation("design", "an estimator must be able to correct what it sent: the last one wins"),
    "nanoseconds": Deviation(
        "ros2", "a stamp is a key, so every nanosecond counts; ROS 1's Python goes through floats"
    ),
    "near-unit quaternion": Deviation("ros2", "a rotation must not scale, so a norm within 1 % is normalised"),
    "norm of 1 %": Deviation("design", "the tolerance is 1 % of the norm; ROS 1's is 1 % of its square"),
    "tiny turn": Deviation("design", "an answer is good to 1e-9 rad however little a frame has turned"),
    "infinity": Deviation("design", "infinity comes out of a later lookup as NaN, so it is refused as NaN is"),
    "not physical": Deviation("design", "a longer translation is no measurement, and a chain of them is infinite"),
    "slash": Deviation("design", "a name is taken as it is or refused, never changed"),
    "reserved name": Deviation("design", "NO_PARENT is a name like any other"),
    "cycle": Deviation("design", "a loop of parents is refused, so that its sender hears of it"),
    "loop in the past": Deviation("design", "only late samples can form one; the two frames are not connected"),
    "depth": Deviation("design", "a chain may have any length"),
    "last kind wins": Deviation("ros2", "static and moving data for one child: the last kind wins"),
    "stamp zero": Deviation("design", "0 is where simulations start; the latest is asked for with LATEST"),
    "static stamp": Deviation(
        "design", "0 would pass for an instant: an answer's stamp is of a sample, or there is none"
    ),
    "latest of itself": Deviation("design", "no edge between a frame and itself has a newest stamp"),
    "stamp of a leg": Deviation("design", "a leg on which nothing moves has no stamp of its own; the other leg has"),
    "unknown in itself": Deviation("design", "a misspelt frame must not pass for one that exists"),
    "query name": Deviation("design", "a name that no sample can have is an unknown frame"),
    "root of nothing": Deviation("design", "a misspelt frame must not pass for a root"),
    "chain": Deviation(
        "design", "a chain is a fact of the topology: both ends included, no sample needed at the stamp"
    ),
    "chain too long": Deviation("design", "a chain goes no further up than the lowest common ancestor"),
    "forgotten name": Deviation("design", "memory stays flat: a frame that no sample in a window names is unknown"),
    "empty history": Deviation("design", "an edge whose samples were cleared is still an edge; more may come"),
    "latest lags": Deviation("design", "LATEST waits for the lagging edge, so its error is that one's, in the future"),
    "disconnected first": Deviation("design", "who waits for the right stamp in the wrong tree waits for ever"),
    "needless edge": Deviation(
        "design", "an edge above the lowest common ancestor can neither fail a lookup nor explain it"
    ),
    "leg that is over": Deviation("design", "one leg is past for good: waiting cannot help, whatever the other lacks"),
    "which edge": Deviation("design", "an edge that is over decides before one that may come: waiting cannot help"),
}

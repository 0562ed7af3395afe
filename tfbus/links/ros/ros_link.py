"""`RosLink`, the base of all links to ROS."""

from typing import Unpack

from tfbus.bus.bus import Bus
from tfbus.links.link import Link
from tfbus.links.ros._carrier import RosCarrier
from tfbus.links.ros.settings import RosOptions


class RosLink(Link):
    """Joins a bus to the transforms of a ROS system, both ways; what all links to ROS have in common.

    Parameters
    ----------
    bus : Bus
    name : str
        How events and log lines call the link.
    carrier : RosCarrier
        Connects to ROS.
    tf, tf_static : str or iterable of str
        The topics of the moving and of the static frames, by default ``/tf`` and ``/tf_static``. If there are several,
        all are heard, and what goes out goes to the first.
    prefix : str, optional
        Put before each name that comes from ROS, such as ``"robot1/"``, and taken off each name that goes there. Frames
        of the bus without it do not go there.
    shared : iterable of str
        Names that are the same on the bus and in ROS in spite of the prefix, such as ``{"map"}``.
    frames : iterable of str, optional
        Send and take only these children, by their names on the bus; by default all.
    send : bool
        Whether anything goes to ROS; else the link only listens.
    authority : str, optional
        The authority of all that comes from ROS; by default the node that has published it, where the link knows it.
    joint_states : callable, optional
        Takes the positions of joints that come from ROS, by their names in rad or m, and the stamp in ns: such as
        `RobotStatePublisher.publish` of a robot. What it raises is counted in `LinkStatistics.rejected`.
    joint_topic : str
        The topic of these, by default ``/joint_states``.
    robot_description : callable, optional
        Takes the URDF of the robot, a str, where ROS has it as a topic, as ``robot_state_publisher`` does in ROS 2.
        What it raises is counted in `LinkStatistics.rejected`.
    description_topic : str
        The topic of that, by default ``/robot_description``.
    clock : SimulatedClock, optional
        Follows ``/clock``, the time of a simulation: it advances, and jumps where that time jumps; one jump back is one
        reset. Give the clock of the bus.
    drop_lost : bool
        Whether the frames of a lost peer leave the bus, those that it was the last to publish.
    max_frames : int
        How many frames one peer may have; samples of others are refused and counted.
    capacity : int
        How many messages of moving frames may wait for the event loop; then the oldest are dropped and counted.

    Raises
    ------
    ValueError
        If a name cannot be that of a topic, the prefix is not valid, or a number is out of range.
    TypeError
        If an argument has the wrong type.

    Notes
    -----
    Nothing in ROS tells where a message comes from. So the bus remembers the newest samples of each child that went
    over it, and takes none of them again: by its child, parent and stamp, a static one by its value as well. Whatever
    connects the buses and the ROS systems, nothing goes round.

    Static frames are latched both ways. Each message on ``/tf_static`` holds all that this link sends, because ROS
    keeps only the last message of each publisher. ROS has no message that removes a frame: a removed static frame is
    missing in the next message, which only late joiners notice, and a removed moving frame is counted in
    `LinkStatistics.not_sent`. A transform that ROS accepts and the bus refuses is counted by its reason and announced
    once, as `PeerRejected` or `SampleRejected`.
    """

    def __init__(self, bus: Bus, name: str, carrier: RosCarrier, **options: Unpack[RosOptions]) -> None:
        super().__init__(
            bus,
            name,
            carrier,
            frames=options.get("frames"),
            drop_lost=options.get("drop_lost", False),
            max_frames=options.get("max_frames", 10_000),
            capacity=options.get("capacity", 10_000),
            clock=options.get("clock"),
        )

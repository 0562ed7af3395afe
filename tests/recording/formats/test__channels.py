import json
from dataclasses import dataclass

import pytest
from rosbags.interfaces import QosDurability, QosHistory, QosReliability
from rosbags.rosbag2.metadata import parse_qos

from tfbus.recording.formats.mcap_output import _MAX_RUNS, MAX_CHANNELS, MAX_SHARED_CHANNELS, Channels, Runs


@dataclass
class Registered:
    topic: str
    metadata: dict[str, str]


def registered(*wanted: tuple[str, Runs]) -> tuple[list[int | None], list[Registered]]:
    """The channels that were registered when some were looked for, and their numbers; None if there was no room."""
    made: list[Registered] = []

    def register(topic: str, metadata: dict[str, str]) -> int:
        made.append(Registered(topic, metadata))
        return len(made) - 1

    channels = Channels(register)
    return [channels.find(topic, runs) for topic, runs in wanted], made


@pytest.mark.parametrize(
    ("topic", "depth", "durability"),
    [("/tf", 100, QosDurability.VOLATILE), ("/tf_static", 1, QosDurability.TRANSIENT_LOCAL)],
)
def test_the_quality_of_service_is_that_of_tf2s_broadcasters(topic: str, depth: int, durability: QosDurability) -> None:
    (number,), channels = registered((topic, [("odometry", 1)]))
    assert number is not None
    assert channels[number].topic == topic
    (offered,) = parse_qos(channels[number].metadata["offered_qos_profiles"])
    assert (offered.history, offered.depth) == (QosHistory.KEEP_LAST, depth)
    assert (offered.reliability, offered.durability) == (QosReliability.RELIABLE, durability)


def test_each_authority_has_one_channel_for_messages_of_any_length() -> None:
    found, channels = registered(
        ("/tf", [("odometry", 1)]), ("/tf", [("odometry", 7)]), ("/tf", [("slam", 1)]), ("/tf_static", [("slam", 2)])
    )
    assert found[0] == found[1]
    assert len(set(found)) == len(channels) == 3
    assert [json.loads(channel.metadata["tfbus.authorities"]) for channel in channels] == [
        [["odometry", 1]],
        [["slam", 1]],
        [["slam", 1]],
    ]


def test_authorities_that_share_a_message_are_told_run_by_run() -> None:
    (number,), channels = registered(("/tf", [("slam", 2), ("", 1), ("\ud800", 3)]))
    assert number is not None
    assert json.loads(channels[number].metadata["tfbus.authorities"]) == [["slam", 2], ["", 1], ["\ud800", 3]]


def test_what_nobody_has_said_is_on_a_channel_as_ros_has_it() -> None:
    found, channels = registered(("/tf", [("", 1)]), ("/tf", [("", 5)]))
    assert found[0] == found[1]
    assert ["tfbus.authorities" in channel.metadata for channel in channels] == [False]


def test_there_is_room_for_so_many_authorities_and_always_for_none() -> None:
    found, channels = registered(
        *(("/tf", [(f"a{number}", 1)]) for number in range(MAX_CHANNELS + 1)), ("/tf", [("", 1)])
    )
    assert found[-2] is None
    assert None not in found[:-2]
    assert found[-1] is not None
    assert len(channels) == MAX_CHANNELS + 1


def test_ways_to_share_a_message_leave_half_of_the_room_to_single_authorities() -> None:
    found, _ = registered(
        *(("/tf", [("a", number), ("b", 1)]) for number in range(1, MAX_SHARED_CHANNELS + 2)), ("/tf", [("a", 1)])
    )
    assert found[-2] is None
    assert None not in found[:-2]
    assert found[-1] is not None


def test_a_message_of_very_many_authorities_has_no_channel_of_its_own() -> None:
    for count, has_one in ((_MAX_RUNS, True), (_MAX_RUNS + 1, False)):
        (number,), _ = registered(("/tf", [(f"a{number}", 1) for number in range(count)]))
        assert (number is not None) == has_one

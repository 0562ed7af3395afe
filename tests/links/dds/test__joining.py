import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from support.both_sides import node

from tfbus.links.dds import _joining
from tfbus.links.dds._carrier import _STATICS
from tfbus.links.dds._domains import configuration, domain
from tfbus.links.dds._joining import delete, is_of_ros, join, read
from tfbus.links.dds._types import RawTFMessage

CONFIG = configuration("localhost", (), None)
CYCLONE_PEER = Path(__file__).parents[2] / "support" / "cyclone_peer.py"


@pytest.mark.parametrize(("user_data", "of_ros"), [(b"enclave=/robot;\0", True), (b"other", False), (b"", False)])
def test_a_participant_of_ros_is_known_by_its_user_data(
    domain_number: int, user_data: bytes, of_ros: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # It has no writers.
    monkeypatch.setattr(_joining, "WRITERS_TIME", 0.05)
    with domain(domain_number, CONFIG), ExitStack() as stack:
        other = DomainParticipant(domain_number, Qos(Policy.Userdata(user_data)))
        stack.callback(delete, other)
        participant = join(domain_number, stack)
        reader = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant)
        stack.callback(delete, reader)
        found = {each.key.hex: is_of_ros(each) for each in read(reader)}
        assert found[other.guid.hex] is of_ros
        assert not found[participant.guid.hex]


@pytest.mark.thorough
def test_whoever_joins_knows_the_writers_of_ros_at_once(domain_number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # However busy the machine is.
    monkeypatch.setattr(_joining, "ANSWER_TIME", 20.0)
    monkeypatch.setattr(_joining, "WRITERS_TIME", 20.0)
    variables = {"ROS_DOMAIN_ID": f"{domain_number}", "CYCLONEDDS_URI": CONFIG}
    with (
        node([sys.executable, str(CYCLONE_PEER)], variables, 60.0),
        domain(domain_number, CONFIG),
        ExitStack() as stack,
    ):
        participant = join(domain_number, stack)
        reader: DataReader[Any] = DataReader(participant, Topic(participant, "rt/tf_static", RawTFMessage), _STATICS)
        stack.callback(delete, reader)
        assert len(reader.get_matched_publications()) == 1

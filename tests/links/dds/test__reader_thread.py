import os
import subprocess
import sys
import weakref
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from cyclonedds.core import DDSStatus
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from support.both_sides import node

from tfbus.links.dds.dds_link import configuration, domain
from tfbus.links.dds.readers import ReaderThread
from tfbus.links.dds.types import RawString
from tfbus.links.ros.messages import decode_text

CONFIG = configuration("localhost", (), None)
CYCLONE_PEER = Path(__file__).parents[2] / "support" / "cyclone_peer.py"
PATIENCE = 30.0


def test_data_and_new_writers_are_told_in_the_thread_and_no_error_ends_it(
    domain_number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    serve, rounds = ReaderThread._serve, list[None]()

    def count(thread: ReaderThread, watched: Any) -> None:
        rounds.append(None)
        serve(thread, watched)

    monkeypatch.setattr(ReaderThread, "_serve", count)
    errors: list[str] = []
    woken = Event()

    def take(reader: DataReader[Any]) -> bool:
        # A sample without data tells of a writer that has gone.
        new = [decode_text(each.payload) for each in reader.take(N=10) if not isinstance(each, InvalidSample)]
        told.extend(new)
        woken.set()
        if "bad" in new:
            raise ValueError(*new)
        return False

    def wait_for(count: int) -> None:
        while len(told) + len(errors) < count:
            assert woken.wait(PATIENCE)
            woken.clear()

    def match(reader: DataReader[Any]) -> None:
        told.append(len(reader.get_matched_publications()))
        woken.set()

    def fail(error: Exception) -> None:
        # Its traceback would keep the reader.
        errors.append(str(error))
        woken.set()

    with domain(domain_number, CONFIG), ExitStack() as stack:
        participant = DomainParticipant(domain_number)
        stack.callback(participant.__del__)
        topic = Topic(participant, "rt/text", RawString)
        thread = ReaderThread(participant, fail)
        reader: DataReader[Any] = DataReader(participant, topic)
        writer = DataWriter(participant, topic)
        # Before it is watched: told all the same.
        writer.write(RawString("first"))
        thread.watch(reader, take, match)
        thread.start()
        wait_for(2)
        for number, text in enumerate(("bad", "last")):
            writer.write(RawString(text))
            wait_for(4 + number)
        writer.__del__()
        wait_for(6)
        thread.stop()
        reader.__del__()
        gone = weakref.ref(reader)
        del reader
        assert gone() is None, "the thread has let go of it"
    assert told == [1, "first", "bad", "last", 0]
    assert len(rounds) < 30, "it rests while nothing comes"
    assert errors == ["bad"]


def test_data_are_taken_though_the_writers_cannot_be_read_and_these_are_read_again(domain_number: int) -> None:
    taken, errors, matched = list[str](), list[str](), list[int]()
    done = Event()

    def match(reader: DataReader[Any]) -> float | None:
        matched.append(len(reader.get_matched_publications()))
        if len(matched) < 3:
            raise IndexError("invalid index")
        done.set()
        return None

    def take(reader: DataReader[Any]) -> bool:
        taken.extend(decode_text(each.payload) for each in reader.take(N=1) if not isinstance(each, InvalidSample))
        return len(taken) < 3

    with domain(domain_number, CONFIG), ExitStack() as stack:
        participant = DomainParticipant(domain_number)
        stack.callback(participant.__del__)
        topic = Topic(participant, "rt/text", RawString)
        reader: DataReader[Any] = DataReader(participant, topic, Qos(Policy.History.KeepAll))
        writer = DataWriter(participant, topic, Qos(Policy.History.KeepAll))
        thread = ReaderThread(participant, lambda error: errors.append(str(error)))
        thread.watch(reader, take, match)
        for text in "abc":
            writer.write(RawString(text))
        thread.start()
        assert done.wait(PATIENCE)
        thread.stop()
        for entity in (writer, reader):
            entity.__del__()
    # One event told of all three, and nothing came after it.
    assert taken == ["a", "b", "c"]
    assert (matched, errors) == ([1, 1, 1], ["invalid index"] * 2)


def test_only_what_is_served_wakes_the_thread(domain_number: int) -> None:
    with domain(domain_number, CONFIG), ExitStack() as stack:
        participant = DomainParticipant(domain_number)
        stack.callback(participant.__del__)
        topic = Topic(participant, "rt/text", RawString)
        readers: list[DataReader[Any]] = [DataReader(participant, topic) for _ in range(2)]
        thread = ReaderThread(participant, print)
        thread.watch(readers[0], bool)
        thread.watch(readers[1], bool, print)
        thread.start()
        masks = [reader.get_status_mask() for reader in readers]
        thread.stop()
        for reader in readers:
            reader.__del__()
    assert masks == [DDSStatus.DataAvailable, DDSStatus.DataAvailable | DDSStatus.SubscriptionMatched]


TWO_LINKS = """
import anyio, sys
from tfbus import Bus, Transform, TransformStamped
from tfbus.links.dds import DdsLink

async def main():
    number = int(sys.argv[1])
    with Bus(max_behind=None) as near, Bus(max_behind=None) as far:
        async with DdsLink(near, number) as here, DdsLink(far, number) as there:
            for stamp in range(4_000):
                near.publish(TransformStamped("map", "near", stamp, Transform()))
                far.publish(TransformStamped("map", "far", stamp, Transform()))
                await anyio.sleep(0.001)
            # Each has heard the other, and the third program.
            assert min(here.statistics().received_samples, there.statistics().received_samples) > 4_100

anyio.run(main)
"""


@pytest.mark.thorough
def test_two_links_of_a_process_and_another_program_do_not_wait_for_each_other_for_ever(domain_number: int) -> None:
    variables = {"ROS_DOMAIN_ID": f"{domain_number}", "CYCLONEDDS_URI": CONFIG}
    with node([sys.executable, str(CYCLONE_PEER)], variables, 60.0):
        command = [sys.executable, "-c", TWO_LINKS, f"{domain_number}"]
        # Which would keep the interpreter lock: only another process can tell.
        done = subprocess.run(command, timeout=60.0, capture_output=True, text=True, env=os.environ, check=False)
    assert (done.returncode, done.stderr) == (0, "")

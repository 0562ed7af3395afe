"""A DDS program that is met as a node of ROS 2 sends garbage to each topic of a link, large messages, and bursts."""

import subprocess
import sys
import threading
from os import environ
from pathlib import Path

import anyio
import pytest
from support.processes import PATIENCE, on_one_loop

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from tfbus import Bus, SimulatedClock
from tfbus.links.dds import DdsLink
from tfbus.links.dds.dds_link import configuration

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.thorough,
    on_one_loop,
]

PEER = Path(__file__).with_name("hostile_cyclone_peer.py")
SUPPORT = Path(__file__).parents[1] / "support"
CASES = 1_000


def resident() -> int:
    """The memory of this process, in MiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4 // 1024


@pytest.mark.parametrize("authority", [None, "ros"])
async def test_whatever_a_program_sends_over_dds_the_link_goes_on_and_counts_what_dds_lets_through(
    authority: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    domain = 200 + (authority is None)
    heard: set[str] = set()
    taken: list[object] = []
    settings = {
        **environ,
        "ROS_DOMAIN_ID": f"{domain}",
        "CYCLONEDDS_URI": configuration("localhost", (), None),
        "PYTHONPATH": f"{SUPPORT}",
    }
    with Bus(SimulatedClock(), max_ahead=None) as bus:
        bus.subscribe(lambda batch: heard.update(sample.child for sample in batch))
        link = DdsLink(
            bus,
            domain,
            authority=authority,
            max_frames=100_000,
            clock=SimulatedClock(),
            joint_states=lambda *joints: taken.append(joints),
            robot_description=taken.append,
        )
        async with link:
            (thread,) = (each for each in threading.enumerate() if each.name == "tfbus dds")
            before, most = resident(), 0
            command = [sys.executable, str(PEER), f"{domain}", f"{CASES}"]
            async with await anyio.open_process(command, env=settings, stderr=subprocess.DEVNULL) as peer:
                with anyio.fail_after(PATIENCE):
                    while "last" not in heard:
                        most = max(most, resident() - before)
                        await anyio.sleep(0.01)
                peer.terminate()
            counts = link.statistics()
            assert thread.is_alive()
    # Of 50,000 transforms, 12 times; and 20,000 that are not finite.
    assert counts.rejected["oversized"] >= 10
    assert counts.rejected["not finite"] >= 20_000
    assert not {"not read", "not published"} & counts.rejected.keys()
    assert counts.received_messages > 3_000
    # The queue of the link holds 64 MiB, and its bus has 20,000 frames.
    assert most < 250
    assert [record for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")] == []

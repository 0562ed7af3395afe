import os
import signal
import time
from pathlib import Path

import anyio
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from support.commands import Command, check_wrong_call, nobody
from support.processes import TFBUS, Program, free_address, new_domain, start_tfbus, until
from support.recorded import messages_in
from support.samples import moving, over, static

from tfbus import Bus, SystemClock, TransformStamped
from tfbus.cli.commands.record import print_summary
from tfbus.recording import open_recording
from tfbus.statistics import QueueStatistics, RecorderStatistics

BACKENDS = ["asyncio", "trio"]


def counters(samples: int, dropped: int = 0, conflated: int = 0, unattributed: int = 0) -> RecorderStatistics:
    queue = QueueStatistics("recorder", "drop_oldest", 1, 0, dropped, conflated)
    return RecorderStatistics(samples, 1, unattributed, {}, queue)


def samples_in(path: Path) -> list[TransformStamped]:
    """All samples of a finished recording."""
    with open_recording(path) as recording:
        assert recording.finished
    return [sample for message in messages_in(path) for sample in message.batch]


async def until_recording() -> None:
    """Wait until the command listens for signals, which would otherwise end the test."""
    while signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:  # noqa: ASYNC110 - nothing announces it
        await anyio.sleep(0.001)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_it_records_what_is_published_until_a_signal_comes(
    path: Path, tfbus: Command, backend: str, number: signal.Signals, status: int
) -> None:
    latched = static("base_link", "camera", authority="me")
    laser = moving("base_link", "laser", time.time_ns(), authority="driver")

    async def publish(bus: Bus) -> None:
        bus.publish(latched)
        await until_recording()
        bus.publish(laser)
        os.kill(os.getpid(), number)
        await anyio.sleep_forever()

    done = tfbus.on_domain(publish, "record", path, "--domain", "yard", "--backend", backend, clock=SystemClock())
    assert (done.returncode, done.stdout) == (status, "")
    assert done.stderr == f"recording domain 'yard' to {path}\n2 samples in {path}\n"
    assert samples_in(path) == [latched, laser]
    with AnyReader([path]) as reader:
        assert {connection.msgtype for connection in reader.connections} == {"tf2_msgs/msg/TFMessage"}
    with path.open("rb") as file:
        assert sum(1 for _ in make_reader(file).iter_messages()) == 2


def test_it_ends_when_the_duration_is_over(path: Path, tfbus: Command) -> None:
    done = tfbus.on_domain(nobody, "record", path, "--duration", "0", "--domain", "yard", clock=SystemClock())
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == f"recording domain 'yard' to {path}\n0 samples in {path}\n"
    assert samples_in(path) == []


def test_samples_that_ros_cannot_hold_are_counted(tmp_path: Path, tfbus: Command) -> None:
    async def publish(bus: Bus) -> None:
        bus.publish([static("base", "\udcff"), static("base", "laser")])
        await anyio.sleep_forever()

    done = tfbus.on_domain(publish, "record", tmp_path / "run.mcap", "--duration", "0", clock=SystemClock())
    assert done.returncode == 0
    *_, count, warning = done.stderr.splitlines()
    assert count.startswith("1 samples in ")
    assert warning.startswith("tfbus: left out, as ROS cannot hold them: 1 x ")


def test_the_summary_warns_of_lost_samples_and_lost_authorities(capsys: pytest.CaptureFixture[str]) -> None:
    print_summary(Path("run.mcap"), counters(samples=1_234))
    assert capsys.readouterr() == ("", "1,234 samples in run.mcap\n")
    print_summary(Path("run.mcap"), counters(samples=5, dropped=1_000, conflated=2, unattributed=1))
    assert capsys.readouterr().err.splitlines() == [
        "5 samples in run.mcap",
        "tfbus: 1,002 samples were lost, because the disk was too slow or failed",
        "tfbus: 1 samples are recorded without their authority: too many of them",
    ]


@pytest.mark.thorough
def test_lost_samples_are_warned_of(tmp_path: Path, tfbus: Command) -> None:
    async def publish_too_many(bus: Bus) -> None:
        await until(lambda: any(tmp_path.iterdir()))
        await anyio.wait_all_tasks_blocked()
        # A thousand more than the recorder holds, before it can write any.
        for number in range(101):
            bus.publish(over("map", "base", range(1_000 * number, 1_000 * number + 1_000)))
        await anyio.wait_all_tasks_blocked()

    done = tfbus.on_domain(publish_too_many, "record", tmp_path / "run.mcap", clock=SystemClock())
    assert "tfbus: the disk is too slow: samples are lost, 1000 so far" in done.stderr.splitlines()


def test_an_existing_file_is_kept_unless_it_may_be_overwritten(path: Path, tfbus: Command) -> None:
    path.write_text("precious")
    command = ("record", path, "--duration", "0")
    done = tfbus.on_domain(nobody, *command, clock=SystemClock())
    check_wrong_call(done, f"{path} is there already: take another name, or give --overwrite")
    assert path.read_text() == "precious"
    assert tfbus.on_domain(nobody, *command, "--overwrite", clock=SystemClock()).returncode == 0
    assert samples_in(path) == []


def test_a_file_that_cannot_be_written_is_one_line_and_status_2(tmp_path: Path, tfbus: Command) -> None:
    path = tmp_path / "nowhere" / "run.mcap"
    done = tfbus.on_domain(nobody, "record", path, clock=SystemClock())
    check_wrong_call(done, f"cannot write {path}: No such file or directory")


@pytest.mark.thorough
def test_a_full_disk_ends_it_with_status_1_and_what_there_was_room_for(path: Path) -> None:
    domain, address = new_domain(), free_address()
    # `ulimit` counts blocks of 512 bytes or of a KiB.
    limited = f'ulimit -f 8; exec "{TFBUS}" record "{path}" --domain {domain} --listen {address}'
    with Program("sh", "-c", limited) as recorder:
        recorder.errors.expect("recording")
        with start_tfbus("broadcast", "--rate", "1000", "--domain", domain, "--connect", address):
            assert recorder.wait() == 1
    lines = recorder.errors.text.splitlines()
    assert lines[-1].startswith("tfbus: the recording has ended early: [Errno ")
    assert "samples were lost" in lines[-2]
    written = int(lines[-3].partition(" ")[0].replace(",", ""))
    assert lines[-3] == f"{written:,} samples in {path}"
    assert len([sample for message in messages_in(path) for sample in message.batch]) >= written > 0

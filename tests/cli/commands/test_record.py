import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from support.processes import new_domain
from support.programs import PATIENCE, TFBUS, Program, free_address, tfbus
from support.recorded import messages_in

from tfbus import TransformStamped
from tfbus.recording import open_recording

BACKENDS = ["asyncio", "trio"]


def samples_in(path: Path) -> list[TransformStamped]:
    """All that a finished recording holds."""
    with open_recording(path) as recording:
        assert recording.finished
    return [sample for message in messages_in(path) for sample in message.batch]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_it_records_a_domain_until_it_is_told_to_stop(
    tmp_path: Path, backend: str, number: signal.Signals, status: int
) -> None:
    path = tmp_path / "run.mcap"
    domain, address = new_domain(), free_address()
    options = ("--domain", domain, "--backend", backend)
    with tfbus("record", str(path), "--listen", address, *options) as recorder:
        assert recorder.errors.expect("recording") == f"recording domain '{domain}' to {path}"
        with (
            tfbus("static", "base_link", "camera", "--xyz", "0", "0", "1", "--connect", address, *options) as static,
            tfbus("broadcast", "--connect", address, *options) as broadcaster,
        ):
            broadcaster.errors.expect("broadcasting")
            static.errors.expect("")
            # So that something has been heard of both.
            with tfbus("echo", "camera", "base_laser", "--rate", "10", "--connect", address, *options) as echo:
                for _ in range(3):
                    echo.output.expect("^At ")
        assert recorder.end(number) == status
        assert "Traceback" not in recorder.errors.text
        assert recorder.output.text == ""
    samples = samples_in(path)
    assert recorder.errors.text.splitlines()[-1] == f"{len(samples):,} samples in {path}"
    moving = [sample for sample in samples if not sample.static]
    assert {(sample.parent, sample.child) for sample in samples if sample.static} == {("base_link", "camera")}
    assert {(sample.child, sample.authority) for sample in moving} == {("base_laser", "robot_tf_publisher")}
    assert len(moving) > 10
    with AnyReader([path]) as reader:
        assert {connection.msgtype for connection in reader.connections} == {"tf2_msgs/msg/TFMessage"}
    with path.open("rb") as file:
        assert sum(1 for _ in make_reader(file).iter_messages()) == len(messages_in(path))


def test_it_ends_by_itself_when_the_time_is_up_and_says_what_it_waits_for(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with tfbus("record", str(path), "--duration", "1.5", "--domain", new_domain()) as recorder:
        assert recorder.wait() == 0
    first, waiting, last = recorder.errors.text.splitlines()
    assert first.startswith("recording domain")
    assert waiting.startswith("waiting for transforms on domain")
    assert last == f"0 samples in {path}"
    assert samples_in(path) == []


def test_a_file_that_is_there_is_kept_unless_it_may_be_lost(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    command = ("record", str(path), "--duration", "0", "--domain", new_domain())
    with tfbus(*command) as recorder:
        assert recorder.wait() == 2
    assert recorder.errors.text == f"tfbus: {path} is there already: take another name, or give --overwrite\n"
    assert path.read_text() == "precious"
    with tfbus(*command, "--overwrite") as recorder:
        assert recorder.wait() == 0
    assert samples_in(path) == []


def test_a_file_that_cannot_be_made_is_one_line_and_status_2(tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / "run.mcap"
    with tfbus("record", str(path), "--domain", new_domain()) as recorder:
        assert recorder.wait() == 2
    assert recorder.errors.text == f"tfbus: cannot write {path}: No such file or directory\n"


def test_a_full_disk_ends_it_with_status_1_and_what_there_was_room_for(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    domain, address = new_domain(), free_address()
    # In blocks of 512 bytes or of a KiB.
    limited = f'ulimit -f 8; exec "{TFBUS}" record "{path}" --domain {domain} --listen {address}'
    with Program("sh", "-c", limited) as recorder:
        recorder.errors.expect("recording")
        with tfbus("broadcast", "--rate", "1000", "--domain", domain, "--connect", address):
            assert recorder.wait() == 1
    lines = recorder.errors.text.splitlines()
    assert lines[-1].startswith("tfbus: the recording has ended early: [Errno ")
    assert "samples were lost" in lines[-2]
    written = int(lines[-3].partition(" ")[0].replace(",", ""))
    assert lines[-3] == f"{written:,} samples in {path}"
    assert len([sample for message in messages_in(path) for sample in message.batch]) >= written > 0


@pytest.mark.parametrize("arguments", [(), ("a.mcap", "--duration", "-1"), ("a.mcap", "--backend", "curio")])
def test_a_wrong_call_is_one_line_on_standard_error_and_status_2(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    done = subprocess.run(
        [TFBUS, "record", *arguments], capture_output=True, text=True, timeout=PATIENCE, cwd=tmp_path, check=False
    )
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (2, "", 1)
    assert done.stderr.startswith("tfbus: ")
    assert list(tmp_path.iterdir()) == []


def test_help_shows_an_example_and_every_option() -> None:
    done = subprocess.run([TFBUS, "record", "--help"], capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert "Example: tfbus record" in done.stdout
    for option in ("--duration", "--overwrite", "--domain", "--listen", "--connect", "--backend"):
        assert option in done.stdout


def test_without_its_extra_it_names_it(tmp_path: Path) -> None:
    hidden = "import sys; sys.modules['mcap.writer'] = None; from tfbus.cli import main; main()"
    command = [sys.executable, "-c", hidden, "record", str(tmp_path / "run.mcap"), "--domain", new_domain()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stderr) == (2, 'tfbus: to record needs a package more: pip install "tfbus[bag]"\n')

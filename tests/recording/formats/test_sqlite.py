"""Files of SQLite, as ROS 2 records them, whole and harmed."""

import shutil
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.processes import is_open
from support.recorded import batches_in, facts, messages_in
from support.samples import moving, static

from tfbus import RecordingError, TransformStamped
from tfbus.recording import load, open_recording
from tfbus.recording.formats.folder import SqliteStorage
from tfbus.recording.formats.storage import MAX_OTHER_MESSAGE
from tfbus.recording.recording import Problems
from tfbus.tf_message import encode

TF = "tf2_msgs/msg/TFMessage"
LINES: list[tuple[int, str, list[TransformStamped]]] = [
    (30, "/tf", [moving("odom", "base", 3)]),
    (10, "/tf_static", [static("base", "laser", 1.0)]),
    (20, "/tf", [moving("odom", "base", 2), moving("base", "wheel", 2)]),
    (20, "/tf", [moving("odom", "base", 1)]),
]
IN_ORDER = [(received, tuple(samples)) for received, _, samples in sorted(LINES, key=lambda line: line[0])]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.db3"


@contextmanager
def written(path: Path, *, oldest_schema: bool = False) -> Iterator[sqlite3.Connection]:
    """A file with the tables of the oldest ROS 2, or of a newer one, as `ros2 bag record` makes them."""
    with closing(sqlite3.connect(path)) as file:
        # Nobody pulls the plug here.
        file.execute("PRAGMA synchronous = OFF")
        further = "" if oldest_schema else ", offered_qos_profiles TEXT NOT NULL DEFAULT ''"
        file.execute(
            f"CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT{further})"
        )
        file.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        if not oldest_schema:
            file.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        topics = [("/camera", "sensor_msgs/msg/Image"), ("/tf", TF), ("/tf_static", TF), ("/tf", "std_msgs/msg/String")]
        for number, (name, kind) in enumerate(topics, 1):
            file.execute(
                "INSERT INTO topics(id, name, type, serialization_format) VALUES (?, ?, ?, 'cdr')", (number, name, kind)
            )
        for received, topic, samples in LINES:
            number = 3 if topic == "/tf_static" else 2
            add(file, number, received, encode(samples))
        add(file, 1, 5, b"a picture")
        add(file, 4, 40, b"a string")
        file.commit()
        yield file
        file.commit()


def write(path: Path, *, oldest_schema: bool = False) -> None:
    with written(path, oldest_schema=oldest_schema):
        pass


def add(file: sqlite3.Connection, topic: int, received: int, data: object) -> None:
    file.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", (topic, received, data))


@pytest.mark.parametrize("oldest_schema", [True, False])
def test_messages_come_by_log_time_from_old_files_and_new_ones(path: Path, oldest_schema: bool) -> None:
    write(path, oldest_schema=oldest_schema)
    assert batches_in(path) == IN_ORDER
    with open_recording(path) as recording:
        assert facts(recording) == (5, 40, 4, True)


def test_a_range_includes_both_ends_and_begins_with_what_was_static(path: Path) -> None:
    write(path)
    assert [message.received for message in messages_in(path, 20, 20)] == [20, 20, 20]
    assert messages_in(path, 25)[0].batch == (static("base", "laser", 1.0),)
    assert [message.received for message in messages_in(path, until=10)] == [10]


def test_what_a_killed_writer_has_left_in_its_log_is_read(tmp_path: Path) -> None:
    running, killed = tmp_path / "running.db3", tmp_path / "killed.db3"
    with closing(sqlite3.connect(running)) as file:
        file.execute("PRAGMA journal_mode = WAL")
    # A running writer has on the disk the files that a killed one leaves.
    with written(running):
        for suffix in ("", "-wal"):
            shutil.copy(f"{running}{suffix}", f"{killed}{suffix}")
    assert Path(f"{killed}-wal").stat().st_size > 0
    assert batches_in(killed) == IN_ORDER
    with open_recording(killed) as recording:
        assert not recording.finished


def test_all_topics_are_told_with_their_definitions_and_the_number_of_their_messages(path: Path) -> None:
    with written(path) as file:
        file.execute("INSERT INTO topics VALUES (5, '/silent', 'a/msg/B', 'cdr', '- history: 1')")
        file.execute("CREATE TABLE message_definitions(topic_type, encoding, encoded_message_definition)")
        file.execute("INSERT INTO message_definitions VALUES ('a/msg/B', 'ros2msg', 'int8 x')")
    with open_recording(path) as recording:
        assert [(topic.name, topic.type, topic.count) for topic in recording.topics] == [
            ("/camera", "sensor_msgs/msg/Image", 1),
            ("/silent", "a/msg/B", 0),
            ("/tf", "std_msgs/msg/String", 1),
            ("/tf", TF, 3),
            ("/tf_static", TF, 1),
        ]
    with closing(SqliteStorage(path)) as storage:
        (silent,) = (channel for channel in storage.channels if channel.topic == "/silent")
    assert (silent.schema_encoding, silent.schema) == ("ros2msg", b"int8 x")
    assert silent.metadata == {"offered_qos_profiles": "- history: 1"}


def test_messages_on_topics_that_are_not_described_are_counted(path: Path) -> None:
    with written(path) as file:
        for number in (98, 99, 99):
            add(file, number, 60, b"")
    *messages, lost = messages_in(path)
    assert [(message.received, message.batch) for message in messages] == IN_ORDER
    assert [error.reason for error in lost.errors] == ["damaged"]
    assert "3 messages are on topics that the file does not describe" in str(lost.errors[0])
    assert lost.received == 30
    # If these are all, at the start.
    for received in (0, 7):
        with closing(sqlite3.connect(path)) as file:
            file.execute("DELETE FROM messages")
            add(file, 99, received, b"")
            file.commit()
        (lost,) = messages_in(path)
        assert (lost.received, len(lost.errors)) == (received, 1)


def test_reading_leaves_nothing_beside_the_file(tmp_path: Path, path: Path) -> None:
    with closing(sqlite3.connect(path)) as file:
        file.execute("PRAGMA journal_mode = WAL")
    write(path)
    batches_in(path)
    assert list(tmp_path.iterdir()) == [path]


def test_a_name_that_looks_like_a_part_of_an_address_is_only_a_name(tmp_path: Path) -> None:
    path = tmp_path / "50% of?mode=rw#1.db3"
    write(path)
    assert batches_in(path) == IN_ORDER


def test_a_message_that_is_no_message_is_counted(path: Path) -> None:
    with written(path) as file:
        for data in (None, "text", 7, b"\0"):
            add(file, 2, 50, data)
    assert [error.reason for message in messages_in(path) for error in message.errors] == ["truncated"] * 4


def test_another_database_is_no_recording(path: Path) -> None:
    with sqlite3.connect(path) as file:
        file.execute("CREATE TABLE people(name TEXT)")
    file.close()
    with pytest.raises(RecordingError, match="an SQLite file, but no recording of ROS 2") as raised:
        open_recording(path)
    assert raised.value.reason == "foreign"
    # Its traceback still refers to the file.
    assert not is_open(path)


def test_a_name_that_is_no_text_is_damage(path: Path) -> None:
    write(path)
    path.write_bytes(path.read_bytes().replace(b"tabletopicstopics", b"tabletopic\xfftopics"))
    with pytest.raises(RecordingError, match="it cannot be read as a recording of ROS 2") as raised:
        open_recording(path)
    assert raised.value.reason == "damaged"


@pytest.mark.parametrize("received", [0, 50])
def test_a_computed_column_cannot_claim_more_than_a_message_may_have(path: Path, received: int) -> None:
    with written(path) as file:
        file.execute("ALTER TABLE messages RENAME TO stored")
        size = MAX_OTHER_MESSAGE + 1
        file.execute(f"CREATE TABLE messages(id INTEGER, topic_id, timestamp, data BLOB AS (zeroblob({size})))")
        file.execute("INSERT INTO messages(topic_id, timestamp) VALUES (2, ?)", (received,))
    lost, promised = messages_in(path)
    assert "nothing more can be read: string or blob too big" in str(lost.errors[0])
    assert "promises 1 messages on '/tf', and 0 were found" in str(promised.errors[0])
    assert (lost.received, promised.received) == (received, received)


def test_a_file_that_one_thread_has_opened_is_read_and_closed_by_another(path: Path) -> None:
    write(path)
    with ThreadPoolExecutor(1) as other:
        recording = other.submit(open_recording, path).result()
    with recording:
        assert [(message.received, message.batch) for message in recording.messages()] == IN_ORDER
    assert not is_open(path)


def killed_writer(path: Path, mode: str) -> None:
    """A file with the messages of `LINES`, whose writer was killed inside of a transaction that changes them all."""
    program = (
        "import os, signal, sqlite3, sys\n"
        "file = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
        "file.execute(f'PRAGMA journal_mode = {sys.argv[2]}')\n"
        "file.execute('PRAGMA cache_size = 1')\n"
        "file.execute('BEGIN')\n"
        "file.execute('UPDATE messages SET topic_id = 99')\n"
        "for number in range(2_000):\n"
        "    file.execute('INSERT INTO messages(topic_id, timestamp, data) VALUES (99, 1, zeroblob(200))')\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    write(path)
    subprocess.run([sys.executable, "-P", "-c", program, str(path), mode], check=False)


@pytest.mark.parametrize(("mode", "journal"), [("DELETE", "-journal"), ("WAL", "-wal")])
@pytest.mark.parametrize("shared", [True, False])
def test_what_a_killed_writer_had_not_finished_is_undone_in_a_copy_and_told(
    tmp_path: Path, path: Path, mode: str, journal: str, shared: bool
) -> None:
    killed_writer(path, mode)
    assert Path(f"{path}{journal}").stat().st_size > 0
    if not shared:
        # The file of a writer-ahead log that the processes share need not be there.
        Path(f"{path}-shm").unlink(missing_ok=True)
    before = {each.name: each.read_bytes() for each in tmp_path.iterdir() if not each.name.endswith("-shm")}
    assert batches_in(path) == IN_ORDER
    problems = Problems()
    load(path, problems=problems)
    assert problems == {"unfinished": 1}
    assert problems.details == [
        "4 messages were read of the file; its writer did not finish it, and its last transaction is undone"
    ]
    assert {each.name: each.read_bytes() for each in tmp_path.iterdir() if not each.name.endswith("-shm")} == before
    assert not (Path(f"{path}-shm").exists() and not shared)


def test_a_journal_removes_no_other_file(tmp_path: Path) -> None:
    path, victim = tmp_path / "run.db3", tmp_path / "precious"
    victim.write_bytes(b"precious")
    killed_writer(path, "DELETE")
    # At the end of a journal may be the name of another one, which SQLite removes behind the last of its children.
    name = str(victim).encode()
    with Path(f"{path}-journal").open("ab") as file:
        file.write(struct.pack(">I", 1_073_741_824 // 4096 + 1) + name)
        file.write(struct.pack(">II", len(name), sum(name)) + bytes.fromhex("d9d505f920a163d7"))
    assert batches_in(path) == IN_ORDER
    assert victim.exists()


ANY_VALUE = st.one_of(
    st.none(),
    st.integers(-(2**63), 2**63 - 1),
    st.sampled_from([0, 1, 2, 3, 1.0, 2.5, "2", "/tf", TF, "cdr", b"2", b"", "x" * 1_000]),
    st.floats(allow_nan=False),
    st.binary(max_size=9),
    st.text(st.characters(codec="utf-8"), max_size=9),
)


@given(
    st.lists(st.tuples(ANY_VALUE, ANY_VALUE, ANY_VALUE, ANY_VALUE, ANY_VALUE), max_size=4),
    st.lists(st.tuples(ANY_VALUE, ANY_VALUE, ANY_VALUE), max_size=6),
    st.sampled_from(["", "INTEGER", "TEXT", "REAL"]),
)
def test_a_column_may_hold_anything(
    tmp_path_factory: pytest.TempPathFactory,
    topics: list[tuple[object, ...]],
    messages: list[tuple[object, ...]],
    affinity: str,
) -> None:
    path = tmp_path_factory.mktemp("any") / "run.db3"
    with closing(sqlite3.connect(path)) as file:
        file.execute("PRAGMA synchronous = OFF")
        file.execute(f"CREATE TABLE topics(id {affinity}, name, type, serialization_format, offered_qos_profiles)")
        file.execute(f"CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id {affinity}, timestamp {affinity}, data)")
        file.execute("INSERT INTO topics VALUES (2, '/tf', ?, 'cdr', '')", (TF,))
        file.executemany("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", topics)
        file.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", messages)
        file.commit()
    try:
        found = messages_in(path)
        messages_in(path, since=0, until=5)
    except RecordingError:
        return
    read = sum(1 for message in found if not message.is_report)
    if read < len(messages):
        with open_recording(path) as recording:
            ignored = sum(topic.count or 0 for topic in recording.topics if not topic.read)
        assert read + ignored == len(messages) or any(message.is_report for message in found)


def test_timestamps_that_are_no_integers_are_counted(path: Path) -> None:
    with written(path) as file:
        for received in (None, "noon", b"\1", 0.5, float("inf")):
            file.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (2, ?, ?)", (received, b""))
    *messages, lost = messages_in(path)
    assert [(message.received, message.batch) for message in messages] == IN_ORDER
    assert "5 messages have a timestamp that is not an integer" in str(lost.errors[0])
    with open_recording(path) as recording:
        assert facts(recording) == (5, 40, 4, True)

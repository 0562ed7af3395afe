"""Bags of ROS 1, read by the package `rosbags`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rosbags.interfaces import ConnectionExtRosbag1
from rosbags.rosbag1 import Reader

from tfbus.errors import RecordingError
from tfbus.recording.formats._storage import Channel, StoredMessage, channel_of, lost_message

MAGIC: Final = b"#ROSBAG V"


class Ros1Storage:
    """A `Storage` of one bag.

    Parameters
    ----------
    path : Path

    Raises
    ------
    RecordingError
        If the bag is damaged, or has no index because its writer was killed.
    """

    finished: Final = True

    def __init__(self, path: Path) -> None:
        self._reader = Reader(path)
        try:
            self._reader.open()
        # For damaged bytes, rosbags raises more than its own errors.
        except Exception as error:
            raise RecordingError(
                f"it cannot be read as a bag of ROS 1: {error}", path=str(path), reason="damaged"
            ) from error
        found = {
            connection.id: channel_of(connection.topic, connection.msgtype, _metadata(connection.ext), ros1=True)
            for connection in self._reader.connections
        }
        self._channels: dict[int, Channel] = {number: channel for number, channel in found.items() if channel}
        times = self._reader.chunk_infos
        self.start = min((chunk.start_time for chunk in times if chunk.connection_counts), default=None)
        # The end that rosbags gives is 1 ns after the last message.
        self.end = max((chunk.end_time - 1 for chunk in times if chunk.connection_counts), default=None)
        self.count = sum(each.msgcount for each in self._reader.connections if each.id in self._channels)

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def messages(self, since: int | None, until: int | None, only_static: bool = False) -> Iterator[StoredMessage]:
        """Iterate over messages, as `Storage.messages`."""
        wanted = {number: channel for number, channel in self._channels.items() if channel.static or not only_static}
        connections = [connection for connection in self._reader.connections if connection.id in wanted]
        if not connections:
            return
        now = self.start or 0
        stop = None if until is None else until + 1
        try:
            for connection, now, payload in self._reader.messages(connections, since, stop):
                yield now, wanted[connection.id], payload
        except Exception as error:  # noqa: BLE001 - damaged bytes, as in opening
            yield lost_message(now, f"nothing more can be read: {error}")


def _metadata(extension: object) -> dict[str, str]:
    sender = extension.callerid if isinstance(extension, ConnectionExtRosbag1) else None
    return {"callerid": sender or ""}

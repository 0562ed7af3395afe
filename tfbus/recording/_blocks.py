"""`Block`, some successive messages of a recording that are decoded together."""

from collections.abc import Callable, Iterable, Iterator, Sequence

from tfbus.recording.formats._columns import ColumnDecoder, Columns
from tfbus.recording.formats._storage import StoredMessage
from tfbus.recording.message import RecordedMessage

SIZE = 8_192
"""The number of messages in a block."""


class Block:
    """Some successive messages.

    Parameters
    ----------
    stored : sequence of StoredMessage
        Also an attribute.
    columns : ColumnDecoder
    decode : callable
        Decodes one message.
    """

    def __init__(
        self,
        stored: Sequence[StoredMessage],
        columns: ColumnDecoder,
        decode: Callable[[StoredMessage], RecordedMessage],
    ) -> None:
        self.stored = stored
        self._columns = columns
        self._decode = decode

    def __len__(self) -> int:
        return len(self.stored)

    def columns(self) -> list[Columns] | None:
        """All samples, by frame; None if the messages have to be decoded one by one."""
        return self._columns.decode(self.stored)

    def messages(self) -> Iterator[RecordedMessage]:
        """All messages, one by one."""
        return map(self._decode, self.stored)


class DecodedBlock:
    """Messages that are decoded already, such as those with the static transforms from before a reading."""

    def __init__(self, messages: Iterable[RecordedMessage]) -> None:
        self._messages = messages

    def __len__(self) -> int:
        return len(self._messages) if isinstance(self._messages, Sequence) else 0

    def columns(self) -> None:
        """None: they are decoded already."""

    def messages(self) -> Iterator[RecordedMessage]:
        """All messages, one by one."""
        return iter(self._messages)

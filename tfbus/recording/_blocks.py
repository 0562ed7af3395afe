"""`Block`, some successive messages of a recording that are decoded together."""

from collections.abc import Callable, Iterable, Iterator, Sequence

from tfbus.recording.formats._columns import ColumnDecoder, Columns
from tfbus.recording.formats._packed import Packed, Stored, pack
from tfbus.recording.formats._storage import StoredMessage
from tfbus.recording.message import RecordedMessage


class Block:
    """Some successive messages.

    Parameters
    ----------
    content : Packed or list of StoredMessage
    columns : ColumnDecoder
    decode : callable
        Decodes one message.
    """

    def __init__(
        self,
        content: Stored,
        columns: ColumnDecoder,
        decode: Callable[[StoredMessage], RecordedMessage],
    ) -> None:
        self._content = content
        self._columns = columns
        self._decode = decode

    def __len__(self) -> int:
        return self._content.size if isinstance(self._content, Packed) else len(self._content)

    @property
    def stored(self) -> list[StoredMessage]:
        """The messages as they are in the file."""
        return self._content.stored() if isinstance(self._content, Packed) else self._content

    def columns(self) -> list[Columns] | None:
        """All samples, by frame and authority; None if the messages have to be decoded one by one."""
        packed = self._content if isinstance(self._content, Packed) else pack(self._content)
        return None if packed is None else self._columns.decode(packed)

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

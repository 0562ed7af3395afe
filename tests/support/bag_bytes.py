"""The records of a bag of ROS 1, byte by byte, for bags that no writer makes."""

import struct


def field(name: bytes, value: bytes) -> bytes:
    return struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value


def record(header: bytes, data: bytes = b"") -> bytes:
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def message(connection: int, seconds: int, data: bytes, order: str = "cot") -> bytes:
    """A message at 5 ns after a second, the fields of its header in the order of these letters."""
    fields = {
        "c": field(b"conn", struct.pack("<I", connection)),
        "o": field(b"op", b"\2"),
        "t": field(b"time", struct.pack("<II", seconds, 5)),
    }
    return record(b"".join(fields[letter] for letter in order), data)


def connection(number: int, own_topic: bytes | None, /, **described: bytes) -> bytes:
    """A connection, with a topic of its own, and with what its data say."""
    header = field(b"conn", struct.pack("<I", number)) + field(b"op", b"\7")
    if own_topic is not None:
        header += field(b"topic", own_topic)
    return record(header, b"".join(field(name.encode(), value) for name, value in described.items()))


def chunk(content: bytes, size: int | None = None) -> bytes:
    """A chunk that is not compressed; it claims the size of its content, or another."""
    claim = struct.pack("<I", len(content) if size is None else size)
    return record(field(b"compression", b"none") + field(b"op", b"\5") + field(b"size", claim), content)


def index(connection: int, *seconds: int) -> bytes:
    """The index of the messages of a connection that comes behind a chunk."""
    header = field(b"ver", struct.pack("<I", 1)) + field(b"op", b"\4")
    header += field(b"conn", struct.pack("<I", connection)) + field(b"count", struct.pack("<I", len(seconds)))
    return record(header, b"".join(struct.pack("<III", second, 5, 0) for second in seconds))


def unfinished(*records: bytes) -> bytes:
    """A bag whose writer was killed before it wrote an index."""
    header = field(b"index_pos", bytes(8)) + field(b"conn_count", bytes(4)) + field(b"chunk_count", bytes(4))
    return b"#ROSBAG V2.0\n" + record(header + field(b"op", b"\3")) + b"".join(records)

"""Decompression with a bound on the result."""

import bz2
from typing import BinaryIO, Final

_BLOCK: Final = 2**20


class UnfoldError(ValueError):
    """Compressed bytes that are damaged, or unfold to more than they may."""


def unfold(data: bytes, compression: str, limit: int, torn: bool = False) -> bytes:
    """Decompress bytes.

    Parameters
    ----------
    data : bytes
    compression : str
        ``"zstd"``, ``"lz4"``, ``"bz2"``; ``""`` and ``"none"`` for bytes that are not compressed.
    limit : int
        The greatest size of the result, in bytes.
    torn : bool
        Whether the data may end too early; then the result is what they unfold to up to there.

    Raises
    ------
    UnfoldError
        If the data are damaged or end too early, the result exceeds `limit`, or the compression is unknown.
    """
    if compression in ("", "none"):
        return _within(data, limit)
    if compression not in _UNFOLD:
        raise UnfoldError(f"the compression {compression!r} is unknown")
    try:
        unfolded, complete = _UNFOLD[compression](data, limit + 1)
    except (OSError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise UnfoldError(f"it cannot be decompressed: {error}") from None
    if not torn and not complete and len(unfolded) <= limit:
        raise UnfoldError("its compressed data end too early")
    return _within(unfolded, limit)


def unfold_file(source: BinaryIO, target: BinaryIO, limit: int) -> None:
    """Decompress a file of Zstandard into another one.

    Raises
    ------
    UnfoldError
        If the file is damaged, or unfolds to more than `limit` bytes.
    OSError
    """
    from zstandard import ZstdDecompressor, ZstdError

    size = 0
    try:
        with ZstdDecompressor().stream_reader(source, read_across_frames=True, closefd=False) as reader:
            while block := reader.read(_BLOCK):
                size += len(block)
                if size > limit:
                    raise UnfoldError(_too_large(limit))
                target.write(block)
    except ZstdError as error:
        raise UnfoldError(f"it cannot be decompressed: {error}") from None


def _within(data: bytes, limit: int) -> bytes:
    if len(data) > limit:
        raise UnfoldError(_too_large(limit))
    return data


def _too_large(limit: int) -> str:
    return f"it holds more than {limit:,} bytes, which is the bound"


def _unfold_zstd(data: bytes, size: int) -> tuple[bytes, bool]:
    from zstandard import ZstdDecompressor, ZstdError

    parts = []
    with ZstdDecompressor().stream_reader(data) as reader:
        try:
            while size > 0 and (part := reader.read(min(size, _BLOCK))):
                parts.append(part)
                size -= len(part)
        except ZstdError as error:
            raise ValueError(str(error)) from None
    # The reader does not tell whether the frame has ended; its checksum and the caller do.
    return b"".join(parts), True


def _unfold_lz4(data: bytes, size: int) -> tuple[bytes, bool]:
    from lz4.frame import LZ4FrameDecompressor

    decompressor = LZ4FrameDecompressor()
    return decompressor.decompress(data, max_length=size), decompressor.eof


def _unfold_bz2(data: bytes, size: int) -> tuple[bytes, bool]:
    decompressor = bz2.BZ2Decompressor()
    return decompressor.decompress(data, max_length=size), decompressor.eof


_UNFOLD: Final = {"zstd": _unfold_zstd, "lz4": _unfold_lz4, "bz2": _unfold_bz2}

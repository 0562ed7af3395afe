import bz2
import io
import tracemalloc
from collections.abc import Callable
from random import Random

import lz4.frame
import pytest
import zstandard

from tfbus.recording.formats.storage import _BLOCK, UnfoldError, unfold, unfold_file

DATA = bytes(range(256)) * 256
FOLD: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.compress,
    "lz4": lz4.frame.compress,
    "bz2": bz2.compress,
    "": bytes,
    "none": bytes,
}
COMPRESSED = ("zstd", "lz4", "bz2")


@pytest.mark.parametrize("kind", FOLD)
def test_what_was_folded_unfolds_to_the_same_up_to_the_bound(kind: str) -> None:
    folded = FOLD[kind](DATA)
    assert unfold(folded, kind, len(DATA)) == DATA
    with pytest.raises(UnfoldError, match=f"more than {len(DATA) - 1:,} bytes"):
        unfold(folded, kind, len(DATA) - 1)


@pytest.mark.parametrize("kind", FOLD)
def test_a_bound_of_whole_blocks_is_a_bound_too(kind: str) -> None:
    data = bytes(2 * _BLOCK)
    assert unfold(FOLD[kind](data), kind, len(data)) == data
    with pytest.raises(UnfoldError, match=f"more than {len(data):,} bytes"):
        unfold(FOLD[kind](data + b"x"), kind, len(data))


@pytest.mark.parametrize("kind", COMPRESSED)
def test_a_torn_part_gives_what_it_unfolds_to(kind: str) -> None:
    # Random bytes, so that there are several blocks.
    data = Random(0).randbytes(1_200_000)
    folded = FOLD[kind](data)
    part = unfold(folded[: len(folded) * 3 // 4], kind, len(data), torn=True)
    assert len(data) // 4 < len(part) < len(data)
    assert data.startswith(part)


@pytest.mark.parametrize("kind", ["lz4", "bz2"])
def test_data_that_end_too_early_are_damage(kind: str) -> None:
    # Without the last byte, all data are there, but not their end.
    for missing in (1, 10):
        with pytest.raises(UnfoldError, match="end too early"):
            unfold(FOLD[kind](DATA)[:-missing], kind, len(DATA))


@pytest.mark.parametrize("kind", COMPRESSED)
def test_no_more_than_the_bound_is_unfolded(kind: str) -> None:
    folded = FOLD[kind](bytes(2**23))
    tracemalloc.start()
    with pytest.raises(UnfoldError, match="more than 1,000 bytes"):
        unfold(folded, kind, 1_000)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20


@pytest.mark.parametrize("kind", COMPRESSED)
def test_nonsense_and_unknown_compressions_are_damage(kind: str) -> None:
    with pytest.raises(UnfoldError, match="cannot be decompressed"):
        unfold(b"\xff" * 100, kind, 1_000)
    with pytest.raises(UnfoldError, match="the compression 'rar' is unknown"):
        unfold(DATA, "rar", len(DATA))


def test_a_file_unfolds_into_another_up_to_the_bound() -> None:
    folded, unfolded = zstandard.compress(DATA), io.BytesIO()
    unfold_file(io.BytesIO(folded), unfolded, len(DATA))
    assert unfolded.getvalue() == DATA
    # A file may have several frames, and stays open.
    source, unfolded = io.BytesIO(folded + folded), io.BytesIO()
    unfold_file(source, unfolded, 2 * len(DATA))
    assert unfolded.getvalue() == DATA + DATA
    assert not source.closed
    with pytest.raises(UnfoldError, match="which is the bound"):
        unfold_file(io.BytesIO(folded), io.BytesIO(), len(DATA) - 1)
    with pytest.raises(UnfoldError, match="cannot be decompressed"):
        unfold_file(io.BytesIO(b"\xff" * 100), io.BytesIO(), len(DATA))

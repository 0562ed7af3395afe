"""The parts that all formats share: selection, merging, packing and unfolding within bounds."""

import bz2
import io
import tracemalloc
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from support.recorded import messages_in, write_mcap
from support.samples import moving

from tfbus.recording.formats import storage
from tfbus.recording.formats.storage import (
    MIB,
    Channel,
    StoredMessage,
    UnfoldError,
    batches,
    max_unpacked,
    shortfalls,
    unfold,
    unfold_file,
)

TF, OTHER, STATIC = Channel("/tf", "", "cdr"), Channel("/tf", "", "cdr"), Channel("/tf_static", "", "cdr")


def test_what_is_promised_is_compared_by_topic() -> None:
    # A flipped bit may turn the number of one channel into that of another one of the topic.
    assert list(shortfalls(5, {TF: 2, OTHER: 2, STATIC: 1}, Counter({TF: 1, OTHER: 3, STATIC: 1}))) == []
    ((received, error, payload),) = shortfalls(5, {TF: 2, OTHER: 2, STATIC: 1}, Counter({TF: 1, OTHER: 2, STATIC: 1}))
    assert (received, payload) == (5, b"")
    assert "the file promises 4 messages on '/tf', and 3 were found" in str(error)


def test_batches_are_bounded_by_number_and_by_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "BLOCK", 3)
    monkeypatch.setattr(storage, "BLOCK_BYTES", 10)
    stored: list[StoredMessage] = [(k, TF, bytes(size)) for k, size in enumerate((1, 1, 1, 9, 1, 30, 1))]
    assert [[len(payload) for _, _, payload in block] for block in batches(iter(stored))] == [
        [1, 1, 1],
        [9, 1],
        [30],
        [1],
    ]
    # Nine bytes do not fill one of ten.
    stored = [(k, TF, bytes(size)) for k, size in enumerate((9, 1, 1))]
    assert [len(block) for block in batches(iter(stored))] == [2, 1]


def test_chunks_that_overlap_beyond_the_bound_are_told_once_and_read_out_of_order(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(storage, "MAX_OVERLAPPING", 1_000)
    # The first message of each chunk comes behind all others.
    times = [k + 1_000 * (k % 5 == 0) for k in range(100)]
    write_mcap(path, [(time, "/tf", [moving("map", "base", time)]) for time in times], chunk_size=500)
    messages = messages_in(path)
    told = [str(error) for message in messages for error in message.errors]
    assert len(told) == 1
    assert told[0].endswith("chunks of more than 1,000 bytes overlap: their messages are not in order")
    received = [message.received for message in messages if message.batch]
    assert sorted(received) == sorted(times) != received


DATA = bytes(range(256)) * 256
FOLD: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.compress,
    "lz4": lz4.frame.compress,
    "bz2": bz2.compress,
    "": bytes,
    "none": bytes,
}
COMPRESSED = ("zstd", "lz4", "bz2")


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


def test_a_small_file_unfolds_to_64_mib_and_a_large_one_to_100_times_its_size() -> None:
    assert max_unpacked(1) == max_unpacked(64 * MIB // 100) == 64 * MIB
    assert max_unpacked(MIB) == 100 * MIB

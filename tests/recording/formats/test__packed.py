from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recorded import SMALL, write_mcap
from support.samples import moving

from tfbus.recording.formats import mcap, storage
from tfbus.recording.formats.mcap import McapStorage
from tfbus.recording.formats.storage import (
    Channel,
    Packed,
    StoredMessage,
    batches,
    blocks_of,
    in_order,
    lost_message,
    pack,
)
from tfbus.recording.recording import open_storage

A, B = Channel("/a", "A", "cdr"), Channel("/b", "B", "cdr")
messages = st.lists(st.tuples(st.integers(0, 50), st.sampled_from([A, B]), st.binary(max_size=9)), max_size=20)


def unpacked(blocks: Iterator[storage.Stored]) -> list[StoredMessage]:
    return [stored for block in blocks for stored in (block.stored() if isinstance(block, Packed) else block)]


@given(stored=messages, low=st.integers(0, 30), high=st.integers(20, 60))
def test_packed_messages_are_those_that_were_packed_in_the_order_of_their_log_times(
    stored: list[StoredMessage], low: int, high: int
) -> None:
    packed = pack(stored)
    assert packed is not None
    assert packed.stored() == stored
    assert packed.size == len(stored)
    assert sum(packed.counts().values()) == len(stored)
    expected = sorted((each for each in stored if low <= each[0] <= high), key=lambda each: each[0])
    assert unpacked(in_order(packed, low, high)) == expected


def test_lost_messages_are_not_packed() -> None:
    assert pack([(1, A, b""), lost_message(2, "gone")]) is None


def test_a_log_time_that_is_no_stamp_comes_last_and_one_by_one() -> None:
    packed = pack([(5, A, b"x"), (3, B, b"y")])
    assert packed is not None
    wrong = packed._replace(received=np.array([-1, 3]))
    assert list(in_order(wrong, 0, 9)) == [[(3, B, b"y"), (2**64 - 1, A, b"x")]]


def test_batches_are_bounded_by_number_and_by_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "BLOCK", 3)
    monkeypatch.setattr(storage, "BLOCK_BYTES", 10)
    stored: list[StoredMessage] = [(k, A, bytes(size)) for k, size in enumerate((1, 1, 1, 9, 1, 30, 1))]
    assert [[len(payload) for _, _, payload in block] for block in batches(iter(stored))] == [
        [1, 1, 1],
        [9, 1],
        [30],
        [1],
    ]
    # Nine bytes do not fill one of ten.
    stored = [(k, A, bytes(size)) for k, size in enumerate((9, 1, 1))]
    assert [len(block) for block in batches(iter(stored))] == [2, 1]


@pytest.mark.parametrize("together", [1, 2**16])
@pytest.mark.parametrize("span", [(None, None), (40, 90)])
def test_a_file_whose_chunks_overlap_is_packed_in_the_order_of_log_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, together: int, span: tuple[int | None, int | None]
) -> None:
    monkeypatch.setattr(mcap, "_FIRST_BLOCK", together)
    monkeypatch.setattr(mcap, "_BLOCK", together)
    # Each chunk ends behind the beginning of the next one.
    times = [k + (15 if k % 10 == 9 else 0) for k in range(120)]
    path = write_mcap(
        tmp_path / "run.mcap", [(time, "/tf", [moving("map", "base", time)]) for time in times], chunk_size=1_000
    )
    storage = McapStorage(path)
    try:
        assert len(storage.index) > 3
        expected = list(storage.messages(lambda _: True, *span))
        assert [received for received, _, _ in expected] == sorted(received for received, _, _ in expected)
        assert unpacked(storage.packed(lambda _: True, *span)) == expected
        assert unpacked(storage.packed(lambda _: False, *span)) == list(storage.messages(lambda _: False, *span))
        monkeypatch.setattr(mcap, "_MOST_OVERLAPPING", 1)
        assert unpacked(storage.packed(lambda _: True, *span)) == expected
    finally:
        storage.close()


def test_storages_that_do_not_pack_give_the_same_messages() -> None:
    storage = open_storage(SMALL)
    try:
        assert unpacked(blocks_of(storage, lambda _: True)) == list(storage.messages(lambda _: True))
    finally:
        storage.close()

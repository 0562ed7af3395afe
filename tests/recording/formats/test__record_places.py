import struct
from itertools import accumulate, cycle, islice

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tfbus.recording.formats import mcap_records
from tfbus.recording.formats.mcap_records import _FIRST_STEPS, record_places


def written(sizes: list[int]) -> bytes:
    # Contents that look like heads must not be taken for them.
    return b"".join(struct.pack("<BQ", 5, size) + bytes(size) for size in sizes)


@given(
    st.lists(st.tuples(st.lists(st.integers(0, 5), min_size=1, max_size=5), st.integers(1, 90)), min_size=1, max_size=4)
)
@example([([1, 2, 3], 90), ([4], 1), ([1, 2, 3], 90)])
def test_all_records_are_found_whether_their_lengths_repeat_or_not(parts: list[tuple[list[int], int]]) -> None:
    sizes = [size for lengths, count in parts for size in islice(cycle(lengths), count)]
    assert record_places(written(sizes)).tolist() == list(accumulate((9 + size for size in sizes), initial=0))


def test_all_records_are_found_wherever_their_lengths_change() -> None:
    for count in range(70):
        sizes = [3] * count + [4, 4, 5, 4, 4, 5] + [3, 1] * 20
        assert record_places(written(sizes)).tolist() == list(accumulate((9 + size for size in sizes), initial=0))


@pytest.mark.parametrize(
    ("lengths", "most"),
    # Half as many may repeat as are read at once; of the last, 62 have to be, and twice as many are read each time.
    [
        ([3], _FIRST_STEPS),
        ([1, 2, 3, 1, 4], _FIRST_STEPS),
        ([*range(_FIRST_STEPS // 2)], _FIRST_STEPS),
        ([*range(30), 7], (1 + 2 + 4) * _FIRST_STEPS),
    ],
)
def test_few_of_many_records_whose_lengths_repeat_are_read_one_by_one(
    monkeypatch: pytest.MonkeyPatch, lengths: list[int], most: int
) -> None:
    read = []

    class Length:
        def unpack_from(self, data: bytes, at: int) -> tuple[int]:
            read.append(at)
            return struct.unpack_from("<Q", data, at)

    monkeypatch.setattr(mcap_records, "_LENGTH", Length())
    sizes = list(islice(cycle(lengths), 10_000))
    assert record_places(written(sizes)).tolist() == list(accumulate((9 + size for size in sizes), initial=0))
    assert len(read) <= most


def test_long_cycles_and_more_records_than_are_guessed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_records, "_GUESSED", 100)
    sizes = list(islice(cycle([*range(30), 7]), 1_000))
    assert record_places(written(sizes)).tolist() == list(accumulate((9 + size for size in sizes), initial=0))


@pytest.mark.parametrize("count", [1, 2, 40])
def test_a_last_record_that_is_cut_off_is_damage(count: int) -> None:
    data = written([3] * count)
    for missing in range(1, 12):
        with pytest.raises((ValueError, struct.error)):
            record_places(data[:-missing])


@pytest.mark.parametrize("size", [2**63, 2**64 - 1, 100])
def test_a_record_that_claims_more_than_there_is_is_damage(size: int) -> None:
    for count in (0, 40):
        with pytest.raises(ValueError, match="behind the end"):
            record_places(written([3] * count) + struct.pack("<BQ", 5, size) + bytes(90))

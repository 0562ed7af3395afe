import pytest
from hypothesis import given
from hypothesis import strategies as st

from tfbus.recording.formats.storage import Channel, ChunkPlace, StoredMessage, merge_chunks, separate

CHANNEL = Channel("/tf", "", "cdr")


@given(chunks=st.lists(st.lists(st.integers(0, 20), min_size=1, max_size=5), max_size=8))
def test_messages_come_by_log_time_and_those_of_one_time_in_the_order_of_the_file(chunks: list[list[int]]) -> None:
    places = sorted(ChunkPlace(min(times), max(times), offset) for offset, times in enumerate(chunks))

    def read(place: ChunkPlace) -> list[StoredMessage]:
        return [(time, CHANNEL, b"%d %d" % (place.offset, at)) for at, time in enumerate(chunks[place.offset])]

    found = [stored for block in merge_chunks(places, read) for stored in block]
    assert found == sorted(
        (stored for place in sorted(places, key=lambda place: place.offset) for stored in read(place)),
        key=lambda stored: stored[0],
    )


@pytest.mark.parametrize(
    ("offsets", "blocks"),
    # In the order of the file, the messages at 5 of the first chunk come before those of the second.
    [((1, 2), [(1, [0, 5]), (2, [5, 9])]), ((2, 1), [(1, [0]), (2, [5, 5, 9])])],
)
def test_a_message_waits_for_the_next_chunk_only_if_one_of_that_may_come_before(
    offsets: tuple[int, int], blocks: list[tuple[int, list[int]]]
) -> None:
    opened: list[int] = []

    def read(place: ChunkPlace) -> list[StoredMessage]:
        opened.append(place.offset)
        return [(place.start, CHANNEL, b""), (place.end, CHANNEL, b"")]

    places = [ChunkPlace(0, 5, offsets[0]), ChunkPlace(5, 9, offsets[1])]
    found = [(len(opened), [received for received, _, _ in block]) for block in merge_chunks(places, read)]
    assert found == blocks


@pytest.mark.parametrize(
    ("spans", "parts"),
    [
        ([], []),
        ([(0, 5)], [1]),
        ([(0, 5), (6, 9)], [1, 1]),
        ([(0, 5), (5, 9)], [1, 1]),
        ([(0, 6), (5, 9)], [2]),
        ([(0, 9), (1, 2), (3, 4), (9, 12), (10, 11), (12, 13)], [3, 2, 1]),
        ([(0, 0), (0, 0)], [1, 1]),
    ],
)
def test_chunks_that_do_not_overlap_are_parts_of_an_index(spans: list[tuple[int, int]], parts: list[int]) -> None:
    places = [ChunkPlace(*span, offset) for offset, span in enumerate(spans)]
    found = separate(places)
    assert [part.stop - part.start for part in found] == parts
    assert [place for part in found for place in places[part]] == places


def test_chunks_that_touch_are_one_part_where_the_file_has_them_in_another_order() -> None:
    last = ChunkPlace(20, 21, 0)
    assert separate([ChunkPlace(0, 5, 1), ChunkPlace(5, 9, 2), last]) == [slice(0, 2), slice(2, 3)]
    assert separate([ChunkPlace(0, 4, 1), ChunkPlace(5, 9, 2), last]) == [slice(0, 1), slice(1, 2), slice(2, 3)]

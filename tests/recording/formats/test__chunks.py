from hypothesis import given
from hypothesis import strategies as st

from tfbus.recording.formats._chunks import ChunkPlace, merge_chunks
from tfbus.recording.formats._storage import Channel, StoredMessage

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

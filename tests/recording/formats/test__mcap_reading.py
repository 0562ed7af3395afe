from pathlib import Path

from support.recorded import write_mcap
from support.samples import moving

from tfbus.recording.formats.mcap import McapReading, McapStorage
from tfbus.stamps import STAMP_MAX


def test_the_index_and_the_order_of_the_file_give_the_same_messages(tmp_path: Path) -> None:
    lines = [(k, "/tf", [moving("map", "base", k)]) for k in range(50)]
    storage = McapStorage(write_mcap(tmp_path / "run.mcap", lines, chunk_size=500))
    try:
        by_index, in_sequence = McapReading(storage, lambda _: True), McapReading(storage, lambda _: True)
        found = [stored for block in by_index.by_index(0, STAMP_MAX) for stored in block]
        assert [received for received, _, _ in found] == list(range(50))
        assert [stored for block in in_sequence.in_sequence(0) for stored in block] == found
        assert (by_index.unknown, by_index.contradictions, in_sequence.unknown) == (0, set(), 0)
        # A reading in sequence has counted the messages, in chunks too.
        assert by_index.counts == in_sequence.counts
        assert list(in_sequence.counts.values()) == [50]
    finally:
        storage.close()

from pathlib import Path

from support.recorded import write_mcap
from support.samples import moving, static

from tfbus.recording import RecordedMessage, open_recording
from tfbus.recording.recording import Block, DecodedBlock


def test_blocks_have_all_messages_decoded_at_once_or_one_by_one(tmp_path: Path) -> None:
    lines = [(k, "/tf", [moving("map", "base", k)]) for k in range(1_000)]
    with open_recording(write_mcap(tmp_path / "run.mcap", lines, chunk_size=70_000)) as recording:
        blocks = list(recording.blocks())
        assert len(blocks) == 2
        assert sum(map(len, blocks)) == 1_000
        for block in blocks:
            columns = block.columns()
            assert columns is not None
            assert [each.stamps.tolist() for each in columns] == [[each.batch[0].stamp for each in block.messages()]]


def test_the_static_transforms_from_before_are_a_block_of_their_own(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf_static", [static("a", "b")]), (5, "/tf", [moving("b", "c", 5)])])
    with open_recording(path) as recording:
        latched, rest = recording.blocks(since=3)
    assert isinstance(latched, DecodedBlock)
    assert isinstance(rest, Block)
    assert len(latched) == 1
    assert list(latched.messages()) == [RecordedMessage(3, (static("a", "b"),), ())]


def test_messages_that_are_not_counted_yet_add_nothing_to_the_progress() -> None:
    message = RecordedMessage(3, (static("a", "b"),), ())
    block = DecodedBlock(iter([message]))
    assert (len(block), list(block.messages())) == (0, [message])

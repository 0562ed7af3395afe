from collections.abc import Iterator

import anyio
import pytest
from support.asking import settle

from tfbus.recording import RecordedMessage
from tfbus.recording.player import ReadAhead

pytestmark = pytest.mark.anyio

COUNT = 2_000


class Tape:
    """Messages, and how many of them were taken."""

    def __init__(self) -> None:
        self.taken = 0
        self.closed = False

    def messages(self) -> Iterator[RecordedMessage]:
        try:
            for number in range(COUNT):
                self.taken += 1
                yield RecordedMessage(number, (), ())
        finally:
            self.closed = True


@pytest.mark.parametrize("ahead", [0, 2])
async def test_the_blocks_contain_the_messages_in_their_order(ahead: int) -> None:
    tape = Tape()
    async with ReadAhead(tape.messages(), ahead) as blocks:
        found = [message.received for block in [block async for block in blocks] for message in block]
    assert found == list(range(COUNT))
    assert tape.closed


async def test_with_zero_ahead_nothing_is_read_while_a_block_is_used() -> None:
    tape = Tape()
    async with ReadAhead(tape.messages(), 0) as blocks:
        read = 0
        async for block in blocks:
            read += len(block)
            for _ in range(3):
                await settle()
                assert tape.taken == read
    assert read == COUNT


async def test_no_more_blocks_are_read_ahead_than_asked_for() -> None:
    tape = Tape()
    async with ReadAhead(tape.messages(), 2) as blocks:
        block = await anext(blocks)
        with anyio.fail_after(30):
            while tape.taken < 3 * len(block):  # noqa: ASYNC110
                await anyio.sleep(0.001)
        for _ in range(3):
            await settle()
        assert tape.taken == 3 * len(block) < COUNT


async def test_an_error_in_the_body_ends_the_reading() -> None:
    tape = Tape()
    with pytest.raises(LookupError, match="the body's own"):
        async with ReadAhead(tape.messages(), 2) as blocks:
            await anext(blocks)
            raise LookupError("the body's own")
    assert tape.closed
    assert tape.taken < COUNT


async def test_an_error_of_reading_is_raised_after_the_last_good_block() -> None:
    def torn() -> Iterator[RecordedMessage]:
        yield from Tape().messages()
        raise OSError("the tape is torn")

    read = 0
    async with ReadAhead(torn(), 2) as blocks:
        with pytest.raises(OSError, match="torn"):
            async for block in blocks:
                read += len(block)
    assert read == COUNT

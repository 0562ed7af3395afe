from collections.abc import Iterator

import anyio
import pytest
from support.asking import settle

from tfbus.recording import RecordedMessage
from tfbus.recording._read_ahead import ReadAhead

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
async def test_the_blocks_are_the_messages_in_their_order(ahead: int) -> None:
    tape = Tape()
    async with ReadAhead(tape.messages(), ahead) as blocks:
        found = [message.received for block in [block async for block in blocks] for message in block]
    assert found == list(range(COUNT))
    assert tape.closed


async def test_without_reading_ahead_nothing_goes_on_behind_the_back_of_who_uses_a_block() -> None:
    tape = Tape()
    async with ReadAhead(tape.messages(), 0) as blocks:
        read = 0
        async for block in blocks:
            read += len(block)
            for _ in range(3):
                await settle()
                assert tape.taken == read
    assert read == COUNT


async def test_no_more_is_read_ahead_than_is_wanted() -> None:
    tape = Tape()
    async with ReadAhead(tape.messages(), 2) as blocks:
        block = await anext(blocks)
        with anyio.fail_after(30):
            while tape.taken < 3 * len(block):  # noqa: ASYNC110
                await anyio.sleep(0.001)
        for _ in range(3):
            await settle()
        assert tape.taken == 3 * len(block) < COUNT


async def test_one_that_is_left_by_an_error_ends_the_reading() -> None:
    tape = Tape()
    with pytest.raises(LookupError, match="the body's own"):
        async with ReadAhead(tape.messages(), 2) as blocks:
            await anext(blocks)
            raise LookupError("the body's own")
    assert tape.closed
    assert tape.taken < COUNT


async def test_what_reading_raises_comes_behind_what_could_be_read() -> None:
    def torn() -> Iterator[RecordedMessage]:
        yield from Tape().messages()
        raise OSError("the tape is torn")

    read = 0
    async with ReadAhead(torn(), 2) as blocks:
        with pytest.raises(OSError, match="torn"):
            async for block in blocks:
                read += len(block)
    assert read == COUNT

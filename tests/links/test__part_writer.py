import pytest
from support.samples import moving, static
from tfbus.links._carrier import SendReport
from tfbus.links._entries import OutgoingBatch, RemovedFrame
from tfbus.links._inbox import ReceivedBatch, ReceivedMessage
from tfbus.links._message import Message, read_message
from tfbus.links._outbox import Turn
from tfbus.links._part_writer import PartWriter
from tfbus.links._state import StateStep

from tfbus import TransformStamped

ORIGIN = b"0123456789abcdef"
CHANGED = StateStep(3, 5, 99)
SAME = StateStep(5, 5, 99)
WANTED = {"arm": {"hand", "tool"}, "base": {"base", "tool"}, "nothing": set[str]()}


def read(message: Message) -> ReceivedMessage:
    return read_message(message.payload, message.attachment)


def batch(number: int, *samples: TransformStamped) -> OutgoingBatch:
    return OutgoingBatch(ORIGIN, number, samples)


def said(message: ReceivedMessage) -> list[tuple[int, list[TransformStamped]] | RemovedFrame]:
    found: list[tuple[int, list[TransformStamped]] | RemovedFrame] = []
    for entry in message.entries:
        assert isinstance(entry, ReceivedBatch | RemovedFrame)
        found.append(entry if isinstance(entry, RemovedFrame) else (entry.sequence, list(entry.samples)))
    return found


class Scene:
    """A writer that serves `WANTED`, and has told the state 5 to all."""

    def __init__(self) -> None:
        self.refused: list[Exception] = []
        self.writer = PartWriter(SendReport(self.refused.append))
        self.writer.serve(WANTED)
        assert self.write(SAME) == {name: [] for name in WANTED}

    def messages(self, step: StateStep, *entries: OutgoingBatch | RemovedFrame) -> dict[str, ReceivedMessage]:
        written = list(self.writer.write(Turn(list(entries), {}, step)))
        assert len(dict(written)) == len(written)
        return {name: read(message) for name, message in written}

    def write(self, step: StateStep, *entries: OutgoingBatch | RemovedFrame) -> dict[str, list[object]]:
        return {name: [*said(message)] for name, message in self.messages(step, *entries).items()}


def test_each_set_has_its_part_of_each_batch_and_removal_in_order() -> None:
    hand, other, tool, base = (moving("map", name, 1) for name in ("hand", "other", "tool", "base"))
    fixed = static("map", "hand", 2.0)
    gone = [RemovedFrame(ORIGIN, 8, "other"), RemovedFrame(ORIGIN, 9, "tool", lost=True)]
    found = Scene().write(SAME, batch(7, hand, other, tool, hand), *gone, batch(10, base), batch(11, fixed))
    assert found == {
        "arm": [(7, [hand, tool, hand]), gone[1], (11, [fixed])],
        "base": [(7, [tool]), gone[1], (10, [base])],
    }


@pytest.mark.parametrize(
    ("entries", "steps"),
    [
        ([batch(1, static("map", "tool"))], {"arm": 3, "base": 3, "nothing": 5}),
        ([batch(1, static("map", "tool"), static("map", "hand"))], {"arm": 3, "base": 5, "nothing": 5}),
        ([batch(1, static("map", "hand")), RemovedFrame(ORIGIN, 2, "base")], {"arm": 5, "base": 5, "nothing": 5}),
        ([RemovedFrame(ORIGIN, 2, "hand")], {"arm": 3, "base": 5, "nothing": 5}),
        ([], {"arm": 3, "base": 3, "nothing": 3}),
    ],
)
def test_a_part_tells_the_change_of_the_state_if_it_is_the_whole_turn_and_else_its_number(
    entries: list[OutgoingBatch | RemovedFrame], steps: dict[str, int]
) -> None:
    scene = Scene()
    changed = StateStep(3, 6, 77)
    found = scene.messages(changed, *entries)
    expected = {name: StateStep(since if since == 3 else 6, 6, 77, message=2) for name, since in steps.items()}
    assert {name: message.step for name, message in found.items()} == expected
    assert {message.number for message in found.values()} == {2}, "numbered, so that a loss is noticed"
    assert scene.messages(StateStep(6, 6, 77)) == {}, "it was told"


def test_nothing_is_written_and_no_number_used_while_nothing_of_a_set_is_published() -> None:
    scene = Scene()
    for stamp in range(3):
        assert scene.write(SAME, batch(stamp, moving("map", "other", stamp))) == {}
    (message,) = scene.messages(SAME, batch(4, moving("map", "hand", 4))).values()
    assert message.number == 2


def test_the_time_of_the_clock_goes_to_all_and_those_who_come_later_are_told_the_newest() -> None:
    scene = Scene()
    told = {name: read(message) for name, message in scene.writer.write(Turn([], {}, SAME, time=70))}
    assert {name: message.time for name, message in told.items()} == dict.fromkeys(WANTED, 70)
    scene.writer.serve({"late": {"hand"}})
    assert {name: message.time for name, message in scene.messages(SAME).items()} == {"late": 70}


def test_a_claim_goes_to_all_and_is_not_repeated_by_the_next_turn() -> None:
    scene = Scene()
    claimed = StateStep(8, 8, 11)
    claims = {name: read(message) for name, message in scene.writer.claim(claimed)}
    assert {name: message.step for name, message in claims.items()} == dict.fromkeys(
        WANTED, StateStep(8, 8, 11, message=1)
    )
    assert {message.number for message in claims.values()} == {0}
    assert scene.messages(claimed) == {}


def test_numbers_go_on_for_a_set_that_stays_and_begin_again_for_one_that_has_gone() -> None:
    scene = Scene()
    turn = [batch(1, moving("map", "tool", 1))]
    scene.writer.serve({"arm": WANTED["arm"]})
    assert {name: message.number for name, message in scene.messages(SAME, *turn).items()} == {"arm": 2}
    scene.writer.serve(WANTED)
    numbers = {name: message.number for name, message in scene.messages(SAME, *turn).items()}
    assert numbers == {"arm": 3, "base": 1, "nothing": 1}
    scene.writer.serve({})
    assert scene.messages(CHANGED, *turn) == {}
    assert list(scene.writer.claim(SAME)) == []


def test_a_turn_that_claims_nothing_is_told_where_it_has_something() -> None:
    writer = PartWriter(SendReport(lambda _: None))
    writer.serve(WANTED)
    written = {name: read(message) for name, message in writer.write(Turn([batch(1, moving("map", "hand", 1))], {}))}
    assert {name: message.step for name, message in written.items()} == {"arm": None}

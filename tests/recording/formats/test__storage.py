from collections import Counter

from tfbus.recording.formats.storage import Channel, StoredMessage, lost_message, select, shortfalls
from tfbus.stamps import STAMP_MAX

TF, OTHER, STATIC = Channel("/tf", "", "cdr"), Channel("/tf", "", "cdr"), Channel("/tf_static", "", "cdr")
BLOCKS: list[list[StoredMessage]] = [[(1, TF, b"a"), (2, STATIC, b"b")], [], [(3, TF, b"c"), (4, TF, b"d")]]


def test_a_range_includes_both_ends_and_what_is_in_it_is_counted() -> None:
    read: Counter[Channel] = Counter()
    assert [stored[0] for stored in select(BLOCKS, 2, 3, read)] == [2, 3]
    assert (read[TF], read[STATIC]) == (1, 1)
    assert [stored[0] for stored in select(BLOCKS, None, None, Counter())] == [1, 2, 3, 4]


def test_a_log_time_that_is_no_stamp_is_lost_at_the_time_before() -> None:
    blocks: list[list[StoredMessage]] = [[(7, TF, b"")], [(2**63, TF, b""), (9, TF, b"")]]
    _, (received, error, _), (last, _, _) = select(blocks, None, None, Counter())
    assert (received, last) == (7, 9)
    assert "has the log time 9223372036854775808 ns" in str(error)
    # The last stamp is one, also beside a log time that is none.
    first, second = select([[(STAMP_MAX, TF, b""), (STAMP_MAX + 1, TF, b"")]], None, None, Counter())
    assert (first, isinstance(second[1], Channel)) == ((STAMP_MAX, TF, b""), False)


def test_a_log_time_that_is_no_stamp_is_lost_at_the_start_of_the_range_or_behind_the_messages_of_its_block() -> None:
    wrong: StoredMessage = (STAMP_MAX + 1, TF, b"")
    cases: list[tuple[int | None, list[list[StoredMessage]], list[int]]] = [
        (None, [[wrong]], [0]),
        (5, [[wrong]], [5]),
        (None, [[(7, TF, b""), (3, TF, b""), wrong]], [7, 3, 7]),
        (None, [[(7, TF, b""), (9, TF, b"")], [wrong, (8, TF, b"")]], [7, 9, 9, 8]),
    ]
    for since, blocks, times in cases:
        assert [received for received, _, _ in select(blocks, since, None, Counter())] == times


def test_lost_messages_are_counted_by_none_of_the_channels() -> None:
    read: Counter[Channel] = Counter()
    assert len(list(select([[(1, TF, b""), lost_message(2, "gone")]], None, None, read))) == 2
    assert (read[TF], read[OTHER]) == (1, 0)


def test_what_is_promised_is_compared_by_topic() -> None:
    # A flipped bit may turn the number of one channel into that of another one of the topic.
    assert list(shortfalls(5, {TF: 2, OTHER: 2, STATIC: 1}, Counter({TF: 1, OTHER: 3, STATIC: 1}))) == []
    ((received, error, payload),) = shortfalls(5, {TF: 2, OTHER: 2, STATIC: 1}, Counter({TF: 1, OTHER: 2, STATIC: 1}))
    assert (received, payload) == (5, b"")
    assert "the file promises 4 messages on '/tf', and 3 were found" in str(error)

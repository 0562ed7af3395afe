from collections import Counter

from tfbus.recording.formats._storage import Channel, StoredMessage, select, shortfalls

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


def test_what_is_promised_is_compared_by_topic() -> None:
    # A flipped bit may turn the number of one channel into that of another one of the topic.
    assert list(shortfalls(5, {TF: 2, OTHER: 2, STATIC: 1}, Counter({TF: 1, OTHER: 3, STATIC: 1}))) == []
    ((received, error, payload),) = shortfalls(5, {TF: 2, OTHER: 2, STATIC: 1}, Counter({TF: 1, OTHER: 2, STATIC: 1}))
    assert (received, payload) == (5, b"")
    assert "the file promises 4 messages on '/tf', and 3 were found" in str(error)

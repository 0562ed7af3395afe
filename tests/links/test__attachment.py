import random
import struct
from itertools import islice

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.processes import peak_of
from support.strategies import CHARACTERS

from tfbus.links._attachment import (
    MAX_BYTES,
    MAX_ENTRIES,
    VERSION,
    Attachment,
    Entry,
    PublishedBatch,
    pack,
    unpack,
)
from tfbus.links._entries import MovingFrame, RemovedFrame
from tfbus.links._state import StateStep
from tfbus.tf_message import MAX_NAME, MalformedMessageError

ONE, OTHER = b"0123456789abcdef", b"another origin !"
NUMBERS = st.integers(0, 2**64 - 1)
NAMES = st.text(CHARACTERS, max_size=20)
ORIGINS = st.binary(min_size=16, max_size=16) | st.sampled_from((ONE, OTHER))
RUNS = st.tuples(NAMES | st.sampled_from(("", "odometry")), st.booleans(), st.integers(0, 2**32 - 1))

entries_of_any_kind: st.SearchStrategy[list[Entry]] = st.lists(
    st.builds(PublishedBatch, ORIGINS, NUMBERS, st.lists(RUNS, max_size=4).map(tuple))
    | st.builds(RemovedFrame, ORIGINS, NUMBERS, NAMES, st.booleans())
    | st.builds(MovingFrame, NAMES),
    max_size=6,
)


STEPS = st.builds(
    lambda since, number, digest, final, message: StateStep(
        min(since, number), max(since, number), digest, final, message
    ),
    NUMBERS,
    NUMBERS,
    NUMBERS,
    st.booleans(),
    NUMBERS,
)


def header(
    origins: int = 0,
    authorities: int = 0,
    entries: int = 0,
    number: int = 1,
    version: int = VERSION,
    claim: tuple[int, int, int, int, int] = (0, 0, 0, 0, 0),
) -> bytes:
    kind, *step = claim
    return struct.pack("<BBBxHIQQQQQ", version, kind, origins, authorities, entries, number, *step)


def entry(kind: int, origin: int = 0, size: int = 0, sequence: int = 1) -> bytes:
    return struct.pack("<BBHQ", kind, origin, size, sequence)


def run(authority: int = 0, static: int = 0, count: int = 1) -> bytes:
    return struct.pack("<HHI", authority, static, count)


def reason_of(data: bytes) -> str:
    with pytest.raises(MalformedMessageError) as caught:
        unpack(data)
    return caught.value.reason


# Both ways.


TIMES = st.none() | st.integers(-(2**63), 2**63 - 1)


def test_the_limits_are_those_of_all_releases() -> None:
    assert (VERSION, MAX_ENTRIES, MAX_BYTES) == (2, 10_000, 1_048_576)


@given(number=NUMBERS, entries=entries_of_any_kind, step=st.none() | STEPS, time=TIMES)
def test_unpacking_gives_back_what_was_packed(
    number: int, entries: list[Entry], step: StateStep | None, time: int | None
) -> None:
    assert unpack(pack(number, entries, step, time)) == Attachment(number, tuple(entries), step, time)


def test_an_attachment_is_laid_out_as_its_module_says() -> None:
    entries: list[Entry] = [
        PublishedBatch(ONE, 7, (("slam", False, 2), ("", True, 1), ("slam", True, 3))),
        RemovedFrame(OTHER, 8, "köln"),
        RemovedFrame(ONE, 9, "b", lost=True),
    ]
    assert pack(5, [MovingFrame("b")], StateStep(6, 7, 8, message=9)) == (
        header(1, 0, 1, number=5, claim=(2, 6, 7, 8, 9)) + bytes(16) + entry(3, 0, 1, 0) + b"b"
    )
    assert pack(5, [], StateStep(6, 7, 0, final=False)) == header(number=5, claim=(1, 6, 7, 0, 0))
    # The fourth byte says that there is a time.
    assert pack(5, [], time=-7) == header(number=5)[:3] + b"\1" + header(number=5)[4:] + struct.pack("<q", -7)
    for times in (1, 2):
        assert reason_of(header()[:3] + b"\2" + header()[4:] + bytes(8 * times)) == "attachment"
    assert reason_of(header()[:3] + b"\1" + header()[4:] + bytes(7)) == "attachment"
    assert pack(5, entries) == (
        header(2, 2, 3, number=5)
        + ONE
        + OTHER
        + b"\4\0slam"
        + b"\0\0"
        + entry(0, 0, 3, 7)
        + run(0, 0, 2)
        + run(1, 1, 1)
        + run(0, 1, 3)
        + entry(1, 1, 5, 8)
        + "köln".encode()
        + entry(2, 0, 1, 9)
        + b"b"
    )


def test_each_sample_of_a_message_has_the_tag_of_its_run() -> None:
    attachment = Attachment(
        1,
        (
            PublishedBatch(ONE, 1, (("a", False, 2), ("b", True, 1))),
            RemovedFrame(ONE, 2, "x"),
            PublishedBatch(OTHER, 3, (("a", False, 0), ("c", False, 1))),
        ),
    )
    assert list(attachment.tags()) == [("a", False), ("a", False), ("b", True), ("c", False)]
    assert [batch.count for batch in attachment.entries if isinstance(batch, PublishedBatch)] == [3, 1]


def test_tags_by_the_billion_are_made_one_by_one() -> None:
    runs = tuple((f"authority {n}", False, 2**32 - 1) for n in range(1_000))
    attachment = unpack(pack(1, [PublishedBatch(ONE, n, runs) for n in range(100)]))

    def read() -> None:
        tags = attachment.tags()
        assert list(islice(tags, 3)) == [("authority 0", False)] * 3

    assert peak_of(read) < 10_000
    assert sum(batch.count for batch in attachment.entries if isinstance(batch, PublishedBatch)) == 10**5 * (2**32 - 1)


# What cannot be packed.


LONGEST = "x" * 65_535


@pytest.mark.parametrize(
    "entries",
    [
        [PublishedBatch(ONE, 1, (("\ud800", False, 1),))],
        [RemovedFrame(ONE, 1, "\udfff")],
        [PublishedBatch(ONE, 1, ((LONGEST + "x", False, 1),))],
        [RemovedFrame(ONE, 1, "x" * (MAX_NAME + 1))],
        [PublishedBatch(n.to_bytes(16), 1, ()) for n in range(256)],
        [PublishedBatch(ONE, n, tuple((f"{n} {k}", False, 1) for k in range(65_000))) for n in range(2)],
        [PublishedBatch(ONE, 1, (("", False, 1),) * 65_536)],
        [RemovedFrame(ONE, n, "x") for n in range(MAX_ENTRIES + 1)],
        [PublishedBatch(ONE, 1, tuple((LONGEST[n:], False, 1) for n in range(17)))],
        [RemovedFrame(ONE, 2**64, "x")],
    ],
    ids=[
        "half a character",
        "half a character in a name",
        "a long authority",
        "a long name",
        "many origins",
        "many authorities",
        "many runs",
        "many entries",
        "many bytes",
        "a high sequence",
    ],
)
def test_too_much_for_one_attachment_is_refused(entries: list[Entry]) -> None:
    with pytest.raises(ValueError, match=r"too much for one attachment|surrogates not allowed"):
        pack(1, entries)


def test_an_attachment_may_have_all_the_bytes_and_not_one_more() -> None:
    names = [f"{number:x}" * len(LONGEST) for number in range(15)]

    def entries(last: int) -> list[Entry]:
        return [PublishedBatch(ONE, 1, tuple((name, False, 1) for name in (*names, "x" * last)))]

    length = MAX_BYTES - len(pack(1, entries(0)))
    packed = pack(1, entries(length))
    assert (len(packed), unpack(packed)) == (MAX_BYTES, Attachment(1, tuple(entries(length))))
    with pytest.raises(ValueError, match=f"{MAX_BYTES + 1} bytes, more than {MAX_BYTES}"):
        pack(1, entries(length + 1))
    assert reason_of(packed + b"x") == "oversized"


def test_the_error_names_the_size() -> None:
    with pytest.raises(ValueError) as raised:
        pack(1, [RemovedFrame(ONE, n, "x" * 1_000) for n in range(2_000)])
    assert str(raised.value) == f"too much for one attachment: {50 + 16 + 2_000 * 1_012} bytes, more than 1048576"


@pytest.mark.parametrize(
    "entries",
    [
        [PublishedBatch(ONE, 1, ((LONGEST, False, 1),))],
        [RemovedFrame(ONE, 1, "x" * MAX_NAME)],
        [PublishedBatch(n.to_bytes(16), 1, ()) for n in range(255)],
        [PublishedBatch(ONE, 1, (("", False, 1), ("", True, 1)) * 32_767)],
        [RemovedFrame(ONE, n, "x") for n in range(MAX_ENTRIES)],
        [PublishedBatch(ONE, 2**64 - 1, tuple((LONGEST[n:], False, 1) for n in range(15)))],
    ],
    ids=["a long authority", "a long name", "many origins", "many runs", "many entries", "many bytes"],
)
def test_the_most_that_is_allowed_comes_back(entries: list[Entry]) -> None:
    assert unpack(pack(2**64 - 1, entries)) == Attachment(2**64 - 1, tuple(entries))


# What is no attachment.


def test_other_versions_are_not_read() -> None:
    assert reason_of(b"") == "version"
    for version in (0, 1, VERSION + 1, 255):
        assert reason_of(header(version=version)) == "version"
    assert unpack(header()) == Attachment(1, ())


GOOD = pack(
    3,
    [
        PublishedBatch(ONE, 7, (("slam", False, 2), ("odometry", True, 1))),
        RemovedFrame(OTHER, 8, "base"),
        PublishedBatch(ONE, 9, (("slam", False, 1),)),
    ],
)


def test_an_attachment_that_is_cut_off_or_too_long_is_refused() -> None:
    for end in range(1, len(GOOD)):
        assert reason_of(GOOD[:end]) == "attachment"
    assert reason_of(GOOD + b"\0") == "attachment"


def test_an_attachment_without_meaning_is_refused() -> None:
    assert reason_of(header(1, 0, 1) + ONE + entry(4)) == "attachment"
    assert reason_of(header(claim=(3, 0, 0, 0, 0))) == "attachment"
    assert reason_of(header(claim=(1, 8, 7, 0, 0))) == "attachment"
    assert reason_of(header(1, 0, 1) + ONE + entry(0, origin=1)) == "attachment"
    assert reason_of(header(0, 0, 1) + entry(1)) == "attachment"
    assert reason_of(header(1, 1, 1) + ONE + b"\0\0" + entry(0, size=1) + run(authority=1)) == "attachment"
    assert reason_of(header(1, 0, 1) + ONE + entry(1, size=2) + b"\xff\xfe") == "attachment"
    assert reason_of(header(0, 1) + b"\1\0\xff") == "attachment"
    assert reason_of(header(1, 0, 1) + ONE + entry(1, size=MAX_NAME + 1) + b"x" * (MAX_NAME + 1)) == "attachment"


# Counts that lie, each in as many bytes as one attachment may have.
ROOM = MAX_BYTES - len(header())
LIES = [
    pytest.param(header(entries=2**32 - 1) + bytes(ROOM), id="entries"),
    pytest.param(header(entries=MAX_ENTRIES + 1) + bytes(ROOM), id="an entry too many"),
    pytest.param(header(entries=MAX_ENTRIES) + bytes(ROOM), id="entries of no origin"),
    pytest.param(header(authorities=65_535) + bytes(ROOM), id="empty authorities"),
    pytest.param(header(authorities=65_535) + b"\xff" * ROOM, id="long authorities"),
    pytest.param(header(255, 0, MAX_ENTRIES) + bytes(ROOM), id="batches of no run"),
    pytest.param(header(255, 1, MAX_ENTRIES) + (b"\0\0\xff\xff" + bytes(8)) * (ROOM // 12), id="batches of many runs"),
    pytest.param(header(1, 1, 2) + ONE + b"\0\0" + entry(0, size=65_535) * 2 + run() * 100_000, id="runs"),
    pytest.param(header(255) + bytes(100), id="origins"),
]


@pytest.mark.parametrize("data", LIES)
@pytest.mark.thorough
def test_counts_that_lie_cost_nothing(data: bytes) -> None:
    peak = peak_of(lambda: reason_of(data))
    assert peak < 10_000 + 16 * len(data)


def test_runs_of_billions_cost_memory_by_their_bytes_only() -> None:
    data = header(1, 1, 1) + ONE + b"\0\0" + entry(0, size=65_535) + run(count=2**32 - 1) * 65_535
    assert peak_of(lambda: unpack(data)) < 32 * len(data)


def test_more_than_the_most_entries_are_not_even_looked_at() -> None:
    removal = entry(1, size=1) + b"a"
    for count in (MAX_ENTRIES, MAX_ENTRIES + 1):
        data = header(1, 0, count) + ONE + removal * count
        if count > MAX_ENTRIES:
            assert reason_of(data) == "oversized"
        else:
            assert len(unpack(data).entries) == count


def test_more_than_the_most_bytes_are_not_even_looked_at() -> None:
    data = header(authorities=65_535) + bytes(MAX_BYTES)
    peak = peak_of(lambda: reason_of(data))
    assert reason_of(data) == "oversized"
    assert peak < 10_000


@given(data=st.binary(max_size=200))
@example(b"\1")
def test_random_bytes_raise_nothing_else(data: bytes) -> None:
    check(data)
    check(bytes([VERSION]) + data)


@given(
    origins=st.integers(0, 2),
    authorities=st.integers(0, 2),
    count=st.integers(0, 3),
    rest=st.binary(max_size=120) | st.lists(st.sampled_from((0, 1, 2, 255)), max_size=120).map(bytes),
)
def test_random_bytes_behind_a_good_header_raise_nothing_else(
    origins: int, authorities: int, count: int, rest: bytes
) -> None:
    check(header(origins, authorities, count) + rest)


@given(entries=entries_of_any_kind, data=st.data())
def test_a_damaged_attachment_raises_nothing_else(entries: list[Entry], data: st.DataObject) -> None:
    damaged = bytearray(pack(1, entries))
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    check(bytes(damaged))


def test_many_damaged_attachments_raise_nothing_else() -> None:
    chance = random.Random(1)
    for _ in range(5_000):
        damaged = bytearray(GOOD)
        for _ in range(chance.randrange(1, 4)):
            damaged[chance.randrange(len(damaged))] = chance.randrange(256)
        check(bytes(damaged[: chance.randrange(1, len(damaged) + 20)]))


def check(data: bytes) -> None:
    """Check that bytes are refused, or that their attachment can be packed again."""
    try:
        attachment = unpack(data)
    except MalformedMessageError:
        return
    assert unpack(pack(attachment.number, attachment.entries, attachment.step)) == attachment

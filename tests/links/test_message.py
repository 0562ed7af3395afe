import json
import math
import pickle
import random
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import strategies as some
from support.processes import peak_of
from support.samples import moving, static

from tfbus import SECOND, Covariance, Transform, TransformStamped, UncertainSample
from tfbus.geometry.covariance import Kind as ErrorKind
from tfbus.links.clocks import read_section, write_section
from tfbus.links.message import (
    LONGEST_WAY,
    MAX_BYTES,
    MAX_ENTRIES,
    MAX_HEAD,
    MAX_SAMPLES,
    MAX_TEXT,
    TEXTS,
    VERSION,
    ChangesQuestion,
    Heard,
    Kind,
    Outgoing,
    PastQuestion,
    Text,
    can_hold,
    kind_of,
    read_message,
    read_question,
    reason_not_to_send,
    split_clocks,
    write_body,
    write_message,
    write_question,
)
from tfbus.links.replica import Claim, Entry, OutgoingBatch, ReceivedBatch, RemovedFrame
from tfbus.tf_message import MalformedMessageError, encode

ONE, OTHER, BUS = b"0123456789abcdef", b"fedcba9876543210", b"a bus of a robot"
NUMBERS = st.integers(0, 2**64 - 1)
LIVE = Outgoing(Kind.LIVE, BUS, 5)
NO_CLOCK = struct.pack("<q", -(2**63))


def batch(*samples: TransformStamped, origin: bytes = ONE, number: int = 1) -> OutgoingBatch:
    return OutgoingBatch(origin, number, samples)


def many(count: int) -> tuple[TransformStamped, ...]:
    return tuple(moving("map", f"f{number}", 1) for number in range(count))


def parts_of(data: bytes) -> list[Heard]:
    """The parts of a message with samples."""
    parts = [part for part in read_message(data) if part is not None]
    assert all(isinstance(part, Heard) for part in parts)
    return parts  # type: ignore[return-value]


def read(data: bytes) -> Heard:
    """A message, its parts put together."""
    first, *rest = parts_of(data)
    entries, errors = list(first.entries), list(first.errors)
    for part in rest:
        entries += part.entries
        errors += part.errors
    return replace(first, entries=entries, errors=errors, goes_on=False)


def facts(entries: Sequence[Any]) -> list[Any]:
    """The facts of entries, to be compared."""
    return [
        entry
        if isinstance(entry, RemovedFrame)
        else (entry.origin, entry.sequence, list(entry.samples), [s.authority for s in entry.samples])
        for entry in entries
    ]


def reason_of(data: bytes) -> str:
    """The reason for which a message is refused, before any part of it."""
    parts: Iterator[object] = read_message(data)
    with pytest.raises(MalformedMessageError) as refused:
        for part in parts:
            assert part is None
    return refused.value.reason


def header(
    kind: int = Kind.LIVE,
    flags: int = 1,
    reach: int = 0,
    origins: int = 0,
    authorities: int = 0,
    entries: int = 0,
    number: int = 5,
    claim: tuple[int, int, int] = (0, 0, 0),
) -> bytes:
    counts = struct.pack("<HHIQ", origins, authorities, entries, number)
    return bytes((VERSION, kind, flags, reach)) + counts + BUS + struct.pack("<QQQ", *claim)


def entry(kind: int, origin: int, size: int, number: int) -> bytes:
    return struct.pack("<BHHQ", kind, origin, size, number)


def tags(*tags: int) -> bytes:
    return struct.pack(f"<{len(tags)}H", *tags)


# Written messages are read back


removals = st.builds(RemovedFrame, st.sampled_from((ONE, OTHER)), NUMBERS, some.frame_names())
batches = st.builds(
    OutgoingBatch,
    st.sampled_from((ONE, OTHER)),
    NUMBERS,
    st.lists(some.samples(at=some.stamps(0, 2**31 * SECOND - 1)), min_size=1, max_size=4),
    st.none() | st.integers(-(2**63) + 1, 2**63 - 1),
)
claims = st.builds(
    lambda one, other, digest, final: Claim(min(one, other), max(one, other), digest, final),
    *[NUMBERS] * 3,
    st.booleans(),
)
buses = st.binary(min_size=16, max_size=16)
outgoing = st.builds(
    Outgoing,
    st.sampled_from(sorted(set(Kind) - TEXTS)),
    buses,
    NUMBERS,
    claims,
    st.none() | st.integers(-(2**63), 2**63 - 1),
    st.lists(st.tuples(buses, st.lists(buses, max_size=LONGEST_WAY).map(tuple)), max_size=4),
    st.booleans(),
)


@given(out=outgoing, entries=st.lists(st.one_of(removals, batches), max_size=5))
def test_a_message_is_read_as_it_was_written(out: Outgoing, entries: list[Any]) -> None:
    data = write_message(out, entries)
    heard = read(data)
    assert kind_of(data) == heard.kind == out.kind
    assert (heard.bus, heard.number, heard.claim, heard.time) == (out.bus, out.number, out.claim, out.time)
    assert (heard.reach, heard.serves, heard.errors) == (out.reach, out.serves, [])
    assert facts(heard.entries) == facts(entries)
    for written, come in zip(entries, heard.entries, strict=True):
        if isinstance(written, OutgoingBatch):
            assert isinstance(come, ReceivedBatch)
            assert come.clock == written.clock


def test_the_stamps_that_a_link_has_corrected_are_written_as_their_sender_gave_them() -> None:
    shifted = replace(batch(moving("map", "a", 107), static("map", "b", stamp=1)), shift=100)
    come = read(write_message(LIVE, [shifted])).entries[0]
    assert isinstance(come, ReceivedBatch)
    assert [sample.stamp for sample in come.samples] == [7, 1]


def test_covariances_come_with_their_samples_and_the_others_have_none() -> None:
    half = np.arange(36.0).reshape(6, 6) % 7.0
    errors = [Covariance(half @ half.T), Covariance.of(xyz=0.1), Covariance.of(rpy=0.2)]
    kinds: list[ErrorKind] = ["drift", "independent", "constant"]
    samples = [
        UncertainSample("map", kind, 5, Transform(), "slam", kind == "constant", covariance=error, kind=kind)
        for error, kind in zip(errors, kinds, strict=True)
    ]
    come = read(write_message(LIVE, [batch(moving("map", "a", 1), *samples), batch(static("map", "b"))])).entries
    assert facts(come) == facts([batch(moving("map", "a", 1), *samples), batch(static("map", "b"))])
    first, second = (entry.samples for entry in come if isinstance(entry, ReceivedBatch))
    assert not isinstance(first[0], UncertainSample)
    assert not isinstance(second[0], UncertainSample)
    for got, error, kind in zip(first[1:], errors, kinds, strict=True):
        for each in (got, pickle.loads(pickle.dumps(got))):
            assert isinstance(each, UncertainSample)
            assert (each.covariance, each.kind) == (error, kind)


def test_the_section_of_clocks_is_taken_off_before_a_message_is_read() -> None:
    section = write_section(5, None, [(b"8 bytes!", 6, 7)])
    message = write_message(replace(LIVE, kind=Kind.SIGN, clocks=section))
    assert split_clocks(message)[1] == section
    assert read(split_clocks(message)[0]).number == 5
    assert read_section(section, b"8 bytes!") == (5, None, (6, 7))
    assert read_section(section, b"another!") == (5, None, None)
    assert split_clocks(write_message(LIVE))[1] == b""


def test_a_message_is_laid_out_as_its_module_says() -> None:
    a, b, c = moving("map", "a", 1, authority="slam"), static("map", "b"), static("map", "c", authority="slam")
    entries: list[Entry] = [replace(batch(a, a, b, c, number=7), clock=77), RemovedFrame(OTHER, 8, "köln")]
    out = Outgoing(Kind.ANSWER, BUS, 5, Claim(6, 7, 8), -9, [(OTHER, (ONE, BUS)), (ONE, ())], serves=True)
    assert write_message(out, entries) == (
        header(5, 1 + 2 + 4, 2, 2, 2, 2, claim=(6, 7, 8))
        + struct.pack("<q", -9)
        + (OTHER + b"\2" + ONE + BUS)
        + (ONE + b"\0")
        + (ONE + struct.pack("<q", 77) + OTHER + NO_CLOCK)
        + (b"\4\0slam" + b"\0\0")
        + (entry(0, 0, 4, 7) + tags(0, 0, 3, 1))
        + (entry(1, 1, 5, 8) + "köln".encode())
        + encode([a, a, b, c])
    )
    assert write_message(Outgoing(Kind.SIGN, BUS, 5)) == header(2, 1)
    assert write_message(Outgoing(Kind.SIGN, BUS, 5, Claim(0, 0, 0, final=False))) == header(2, 0)


def test_a_large_message_comes_in_parts_with_its_batches_whole_and_time_for_others_between() -> None:
    entries = [batch(*many(150), number=number) for number in range(10)] + [RemovedFrame(ONE, 99, "gone")]
    claim = Claim(0, 3, 4)
    data = write_message(Outgoing(Kind.ANSWER, BUS, 0, claim, 7), entries)
    assert None in list(read_message(data))
    parts = parts_of(data)
    assert len(parts) >= 5
    assert [part.continues for part in parts] == [False] + [True] * (len(parts) - 1)
    assert [part.goes_on for part in parts] == [True] * (len(parts) - 1) + [False]
    assert [part.time for part in parts] == [7] + [None] * (len(parts) - 1)
    assert facts(read(data).entries) == facts(entries)
    removed = [RemovedFrame(ONE, number, f"f{number}") for number in range(MAX_ENTRIES)]
    parts = parts_of(write_message(LIVE, removed))
    assert max(len(part.entries) for part in parts) <= 500
    assert [each for part in parts for each in part.entries] == removed


def test_a_sample_that_cannot_be_decoded_is_an_error_and_the_others_stay_in_their_batches() -> None:
    samples = [moving("map", name, 1) for name in "abcd"]
    data = bytearray(write_message(LIVE, [batch(*samples[:3]), batch(samples[3], number=2)]))
    # The w of the second sample.
    at = [k for k in range(len(data) - 7) if data[k : k + 8] == struct.pack("<d", 1.0)][1]
    data[at : at + 8] = struct.pack("<d", math.nan)
    heard = read(bytes(data))
    assert [error.reason for error in heard.errors] == ["not finite"]
    assert facts(heard.entries) == facts([batch(samples[0], samples[2]), batch(samples[3], number=2)])


@given(body=st.binary(max_size=60), kind=st.sampled_from(sorted(TEXTS)))
def test_a_text_has_its_body_behind_version_and_kind(body: bytes, kind: Kind) -> None:
    assert list(read_message(write_body(kind, body))) == [Text(kind, body)]


@pytest.mark.parametrize("question", [ChangesQuestion(3, ("a", "b")), ChangesQuestion(0, None), PastQuestion(5.0, "a")])
def test_a_question_is_a_json_object_of_its_fields(question: ChangesQuestion | PastQuestion) -> None:
    body = write_question(question)
    assert read_question(type(question), body) == question
    for bad in (b"", b"\xff", b"[]", b"3", b"{", b"{}", b"[" * 100_000, body + b"x", json.dumps("a").encode()):
        with pytest.raises(MalformedMessageError) as refused:
            read_question(type(question), bad)
        assert refused.value.reason == "text"


# Bounds


def test_as_much_as_is_allowed_is_written_and_read_and_no_more() -> None:
    assert len(read(write_message(LIVE, [batch(*many(MAX_SAMPLES))])).entries) == 1
    removed = [RemovedFrame(ONE, number, "a") for number in range(MAX_ENTRIES)]
    assert len(read(write_message(LIVE, removed)).entries) == MAX_ENTRIES
    authority = "x" * 65_535
    heard = read(write_message(LIVE, [batch(moving("map", "a", 1, authority=authority))]))
    assert facts(heard.entries)[0][3] == [authority]
    longest = [RemovedFrame(ONE, 1, "x" * 1_024)]
    assert facts(read(write_message(LIVE, longest)).entries) == longest


@pytest.mark.parametrize(
    "entries",
    [
        [batch(*many(MAX_SAMPLES + 1))],
        [RemovedFrame(ONE, number, "a") for number in range(MAX_ENTRIES + 1)],
        [RemovedFrame(ONE, 1, "x" * 1_025)],
        [RemovedFrame(ONE, 1, "\ud800")],
        [RemovedFrame(ONE, 2**64, "a")],
        [batch(moving("map", "a", 1, authority="x" * 65_536))],
        [batch(moving("map", "a", 1, authority="\ud800"))],
        [batch(moving("map", "a", 2**62))],
        [batch(moving("map", "a", 1, authority=f"{number}{'x' * 60_000}")) for number in range(18)],
        [batch(*(moving("map", f"{n}{'x' * 1_000}", 1) for n in range(5_000)))],
    ],
    ids=["samples", "entries", "name", "surrogate", "number", "authority", "text", "stamp", "head", "bytes"],
)
def test_what_one_message_cannot_hold_is_a_value_error(entries: list[Entry]) -> None:
    with pytest.raises(ValueError, match=r"."):
        write_message(LIVE, entries)


def test_a_sample_that_no_message_can_hold_is_told_with_the_reason() -> None:
    assert can_hold(moving("map", "a", 1))
    refused = [
        moving("map", "a", 2**62),
        moving("map", "x" * 1_025, 1),
        moving("map", "a", 1, authority="x" * 65_536),
        moving("map", "a", 1, authority="\ud800"),
    ]
    reasons = [reason_not_to_send(sample) for sample in refused]
    assert [error and error.reason for error in reasons] == ["stamp", "frame name", "authority", "authority"]
    assert not any(map(can_hold, refused))


# Foreign bytes

UNCERTAIN = (
    header(origins=1, authorities=1, entries=1) + ONE + NO_CLOCK + b"\0\0" + struct.pack("<BHHQ", 2, 0, 1, 1) + b"\0\0"
)
"""A batch of one sample, whose covariance is missing."""


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "version"),
        (b"\4", "version"),
        (b"\3\1" + header()[2:], "version"),
        (header(kind=0), "version"),
        (header(kind=77), "version"),
        (header()[:-1], "head"),
        (header(claim=(2, 1, 0)), "head"),
        (header(flags=3), "head"),
        (header(reach=1), "head"),
        (header(reach=1) + ONE + b"\2" + ONE, "head"),
        (header(reach=1) + ONE + bytes((LONGEST_WAY + 1,)) + ONE * (LONGEST_WAY + 1), "head"),
        (header(origins=2) + ONE + NO_CLOCK + OTHER, "head"),
        (header(authorities=1) + b"\4\0slo", "head"),
        (header(authorities=1) + b"\1\0\xff", "head"),
        (header(origins=1, entries=1) + ONE + NO_CLOCK, "head"),
        (header(origins=1, entries=1) + ONE + NO_CLOCK + entry(3, 0, 0, 1), "head"),
        (header(origins=1, authorities=1, entries=1) + ONE + NO_CLOCK + b"\0\0" + entry(2, 0, 1, 1) + tags(0), "head"),
        (UNCERTAIN + b"\1" + struct.pack("<21d", *[math.nan] * 21), "head"),
        (UNCERTAIN + b"\1" + struct.pack("<21d", *[-1.0] * 21), "head"),
        (UNCERTAIN + b"\4" + bytes(168), "head"),
        (header(origins=1, entries=1) + ONE + NO_CLOCK + entry(1, 1, 1, 1) + b"a", "head"),
        (header(origins=1, entries=1) + ONE + NO_CLOCK + entry(1, 0, 2, 1) + b"a", "head"),
        (header(origins=1, entries=1) + ONE + NO_CLOCK + entry(1, 0, 1, 1) + b"\xff", "head"),
        (header(origins=1, entries=1) + ONE + NO_CLOCK + entry(1, 0, 1_025, 1) + b"a" * 1_025, "head"),
        (header(origins=1, entries=1) + ONE + NO_CLOCK + entry(0, 0, 1, 1), "head"),
        (header(origins=1, entries=1) + ONE + NO_CLOCK + entry(0, 0, 1, 1) + tags(0), "head"),
        (
            header(origins=1, authorities=1, entries=1) + ONE + NO_CLOCK + b"\0\0" + entry(0, 0, 1, 1) + tags(0),
            "truncated",
        ),
        (header(entries=MAX_ENTRIES + 1), "oversized"),
        (header() + encode([moving("map", "a", 1)]), "tags"),
        (header() + b"x", "truncated"),
        (header() + bytes(MAX_BYTES), "oversized"),
        (header(kind=Kind.QUESTION) + bytes(MAX_TEXT), "oversized"),
        (header(authorities=20) + (b"\xff\xff" + b"x" * 65_535) * 20, "head"),
    ],
)
def test_bytes_that_are_no_message_are_refused_with_the_reason(data: bytes, reason: str) -> None:
    assert reason_of(data) == reason


def test_nothing_of_a_large_message_that_is_malformed_at_its_end_is_a_part() -> None:
    data = write_message(LIVE, [batch(*many(1_000))])
    assert reason_of(data + bytes(8)) == "oversized"
    assert reason_of(data[:-1]) == "truncated"


def test_a_message_with_too_many_samples_is_refused_before_they_are_decoded() -> None:
    head = header(origins=1, authorities=1, entries=1) + ONE + NO_CLOCK + b"\0\0" + entry(0, 0, MAX_SAMPLES + 1, 1)
    assert reason_of(head) == "oversized"


def test_counts_that_lie_cost_little_memory() -> None:
    data = header(origins=1, authorities=1, entries=1) + ONE + NO_CLOCK + b"\0\0" + entry(0, 0, MAX_SAMPLES, 1)
    assert peak_of(lambda: reason_of(data)) < 100_000
    for lie in ({"reach": 255}, {"origins": 65_535}, {"authorities": 65_535}, {"entries": MAX_ENTRIES}):
        assert peak_of(lambda lie=lie: reason_of(header(**lie))) < 10_000_000  # type: ignore[misc]


def harmless(data: bytes) -> None:
    try:
        for _ in read_message(data):
            pass
    except MalformedMessageError as error:
        assert len(str(error)) < 1_000


@given(st.sampled_from(Kind), st.binary(max_size=300))
def test_random_bytes_behind_version_and_kind_raise_nothing_else(kind: Kind, data: bytes) -> None:
    harmless(data)
    harmless(bytes((VERSION, kind)) + data)
    harmless(header(kind, reach=1, origins=1, authorities=1, entries=1) + data)


def test_a_message_with_wrong_bytes_raises_nothing_else() -> None:
    chance = random.Random(2)
    samples = [moving("map", "a", 1, authority="slam"), static("a", "b"), moving("b", "c", 1)]
    out = Outgoing(Kind.ANSWER, BUS, 5, Claim(6, 7, 8), 9, [(OTHER, (ONE,))])
    good = write_message(out, [batch(*samples), RemovedFrame(OTHER, 1, "c"), batch(*samples, number=2)])
    for cut in range(len(good)):
        reason_of(good[:cut])
    for _ in range(3_000):
        bad = bytearray(good)
        for _ in range(chance.randrange(1, 4)):
            bad[chance.randrange(len(bad))] = chance.randrange(256)
        harmless(bytes(bad))


def test_a_head_may_have_all_its_bytes_and_not_one_more() -> None:
    empty = RemovedFrame(ONE, 1, "")
    size = len(write_message(LIVE, [empty, empty])) - len(write_message(LIVE, [empty]))
    count, rest = divmod(MAX_HEAD - len(write_message(LIVE, [empty])), size + 1_000)
    entries = [*[RemovedFrame(ONE, 1, "x" * 1_000)] * count, RemovedFrame(ONE, 1, "x" * rest)]
    data = write_message(LIVE, entries)
    assert len(data) == MAX_HEAD
    assert read(data).entries == entries
    with pytest.raises(ValueError, match=f"{MAX_HEAD + 1} bytes before the samples"):
        write_message(LIVE, [*entries[:-1], RemovedFrame(ONE, 1, "x" * (rest + 1))])
    longer = header(origins=1, entries=count + 2) + data[len(header()) :] + entry(1, 0, 0, 1)
    assert reason_of(longer) == "head"

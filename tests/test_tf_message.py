"""Messages of tf, to and from bytes."""

import copy
import itertools
import math
import pickle
import random
import struct
import tracemalloc
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from support import strategies as some
from support.processes import peak_of
from support.samples import moving

import tfbus
from tfbus import SECOND, InvalidTransformError, Transform, TransformStamped
from tfbus.rows import IDENTITY, Row
from tfbus.tf_message import (
    MAX_NAME,
    MIN_SIZE,
    MalformedMessageError,
    decode,
    decode_in_parts,
    encode,
    plain_decoder,
    refusal,
)

MESSAGE = "tf2_msgs/msg/TFMessage"
ROS = get_typestore(Stores.ROS2_JAZZY)

FIRST_STAMP = -(2**31) * SECOND
LAST_STAMP = 2**31 * SECOND - 1
NOT_FINITE = (math.nan, math.inf, -math.inf)

sendable = st.lists(some.samples(at=some.stamps(FIRST_STAMP, LAST_STAMP)), max_size=5)


class Part(NamedTuple):
    """One transform of a message, good or bad."""

    parent: bytes = b"map"
    child: bytes = b"base"
    sec: int = 12
    nanosec: int = 5
    numbers: Row = IDENTITY


def message_of(*parts: Part, order: str = "<") -> bytes:
    """A message, written number by number with the alignment that CDR wants."""
    body = bytearray()

    def add(kind: str, value: float) -> None:
        body.extend(bytes(-len(body) % struct.calcsize(kind)))
        body.extend(struct.pack(order + kind, value))

    add("I", len(parts))
    for part in parts:
        add("i", part.sec)
        add("I", part.nanosec)
        for name in (part.parent, part.child):
            add("I", len(name) + 1)
            body.extend(name + b"\0")
        for number in part.numbers:
            add("d", number)
    return {"<": b"\0\1\0\0", ">": b"\0\0\0\0"}[order] + bytes(body)


def by_ros(samples: Iterable[TransformStamped], little_endian: bool = True) -> bytes:
    """The message as rosbags writes it."""
    kinds = ROS.types

    def transform_of(sample: TransformStamped) -> Any:
        sec, nanosec = divmod(sample.stamp, SECOND)
        stamp = kinds["builtin_interfaces/msg/Time"](sec, nanosec)
        translation = kinds["geometry_msgs/msg/Vector3"](*sample.transform.translation)
        rotation = kinds["geometry_msgs/msg/Quaternion"](*sample.transform.rotation)
        return kinds["geometry_msgs/msg/TransformStamped"](
            kinds["std_msgs/msg/Header"](stamp, sample.parent),
            sample.child,
            kinds["geometry_msgs/msg/Transform"](translation, rotation),
        )

    message = kinds[MESSAGE]([transform_of(sample) for sample in samples])
    return bytes(ROS.serialize_cdr(message, MESSAGE, little_endian=little_endian))


def tags_of(samples: Iterable[TransformStamped]) -> list[tuple[str, bool]]:
    return [(sample.authority, sample.static) for sample in samples]


def bits(sample: TransformStamped | None) -> tuple[object, ...]:
    """Everything in a sample, with numbers that only a bit tells apart kept apart."""
    assert sample is not None
    row = (*sample.transform.translation, *sample.transform.rotation)
    return sample.parent, sample.child, sample.stamp, struct.pack("<7d", *row), sample.authority, sample.static


def reason_of(payload: bytes | memoryview, tags: Iterable[tuple[str, bool]] | None = None) -> str:
    with pytest.raises(MalformedMessageError) as caught:
        decode(payload, tags)
    return caught.value.reason


@given(samples=sendable)
def test_messages_are_those_of_rosbags_and_come_back_bit_for_bit_in_both_byte_orders(
    samples: list[TransformStamped],
) -> None:
    payload = encode(samples)
    assert payload == by_ros(samples)
    other = by_ros(samples, little_endian=False)
    assert (payload[1], other[1]) == (1, 0)
    for message in (payload, other):
        decoded = decode(message, tags_of(samples))
        assert [bits(sample) for sample in decoded.samples] == [bits(sample) for sample in samples]
        assert decoded.errors == []


# Encoding


@pytest.mark.parametrize(
    ("parent", "child", "stamp", "reason"),
    [
        ("map", "base", FIRST_STAMP - 1, "stamp"),
        ("map", "base", LAST_STAMP + 1, "stamp"),
        ("map", "base", 2**63 - 1, "stamp"),
        ("map", "\ud800", 0, "frame name"),
        ("a\udfffb", "base", 0, "frame name"),
        ("map", "a" * (MAX_NAME + 1), 0, "frame name"),
        ("ü" * (MAX_NAME // 2) + "a", "base", 0, "frame name"),
    ],
)
def test_a_sample_that_a_message_cannot_hold_is_refused_with_its_facts(
    parent: str, child: str, stamp: int, reason: str
) -> None:
    bad = moving(parent, child, stamp, authority="odometry")
    good = moving("map", "base", 0)
    with pytest.raises(InvalidTransformError) as caught:
        encode([good, bad, good])
    error = caught.value
    assert (error.reason, error.parent, error.child, error.authority) == (reason, parent, child, "odometry")
    told = refusal(bad)
    assert told is not None
    assert (str(told), vars(told)) == (str(error), vars(error))
    assert refusal(good) is None


@pytest.mark.parametrize("name", ["a" * MAX_NAME, "ü" * (MAX_NAME // 2), "a\0b"])
def test_a_name_of_the_greatest_length_or_with_a_nul_is_decoded_again(name: str) -> None:
    samples = [moving("map", name, 0), moving(name, "base", 0)]
    assert [refusal(sample) for sample in samples] == [None, None]
    assert encode(samples) == by_ros(samples)
    assert decode(encode(samples)).samples == samples


# Decoding what is good.


@pytest.mark.parametrize("most", [1, 3, 4, 5])
def test_a_message_in_parts_is_the_whole_one(most: int) -> None:
    payload = encode([moving("map", f"frame{'x' * number}", number) for number in range(4)])
    whole = decode(payload, kind=TransformStamped)
    parts = list(decode_in_parts(payload, most, TransformStamped))
    assert [sample for part in parts for sample in part.samples] == whole.samples
    assert max(len(part.samples) for part in parts) <= most
    for bad, sound in ((payload[:-1], 3), (payload + b"more", 4)):
        parts = []
        with pytest.raises(MalformedMessageError, match=r"truncated|oversized"):
            for part in decode_in_parts(bad, 1, TransformStamped):
                parts.append(part)
        assert len(parts) == sound


@given(sendable, st.binary(max_size=9))
def test_the_decoder_of_plain_messages_gives_the_same_or_nothing(
    samples: list[TransformStamped], behind: bytes
) -> None:
    payload = encode(samples)
    whole = decode(payload, [("me", True)] * len(samples), bare_names=True)
    decode_plain = plain_decoder(("me", True), len(payload) + 4)
    assert decode_plain(payload) in (None, tuple(whole.samples))
    for other in (payload[:-1], payload[: len(behind)], payload + behind + b"\1", b"\0\0" + payload[2:], behind):
        assert other == payload or decode_plain(other) is None


def test_the_compiled_kernel_knows_plain_messages_by_their_names() -> None:
    payload = message_of(Part(), Part(child=b"arm"))
    samples = decode(payload, [("me", False)] * 2, bare_names=True).samples
    plain = tuple(samples) if tfbus.kernel == "compiled" else None
    assert plain_decoder(("me", False), len(payload))(payload) == plain
    assert plain_decoder(("me", False), len(payload) - 1)(payload) is None
    assert plain_decoder(("me", False), len(payload))(message_of(Part(child=b"never heard of"))) is None


def test_options_of_the_header_paddings_and_a_buffer_around_it_do_not_change_a_message() -> None:
    samples = [moving("map", "base", 7)]
    payload = encode(samples)
    within = payload.index(b"base\0") + 5
    same_messages: tuple[bytes | memoryview, ...] = (
        payload[:2] + b"\xff\x03" + payload[4:],
        payload[:within] + b"\xff\xfe\xfd" + payload[within + 3 :],
        memoryview(b"xyz" + payload + b"xyz")[3:-3],
        *(payload + bytes(zeros) for zeros in range(4)),
    )
    for same in same_messages:
        assert decode(same).samples == samples
    assert [decode(encode([]) + bytes(zeros)).samples for zeros in range(4)] == [[]] * 4


class Marked(TransformStamped):
    __slots__ = ("mark",)
    mark: str


def test_samples_have_the_given_type() -> None:
    samples = [moving("map", "base", 7, authority="odometry")]
    for _ in range(2):
        (marked,) = decode(encode(samples), tags_of(samples), kind=Marked).samples
        assert type(marked) is Marked
        assert bits(marked) == bits(samples[0])
        marked.mark = "mine"


# Decoding what is bad, one transform at a time.


def expected(part: Part, tag: tuple[str, bool], bare_names: bool) -> TransformStamped | InvalidTransformError:
    """The transform that the classes themselves make of its parts."""
    try:
        if part.nanosec >= SECOND:
            raise InvalidTransformError("", reason="stamp")
        parent, child = part.parent.decode(), part.child.decode()
        if bare_names:
            parent, child = parent.lstrip("/"), child.lstrip("/")
        transform = Transform(part.numbers[:3], part.numbers[3:])
        return TransformStamped(parent, child, part.sec * SECOND + part.nanosec, transform, *tag)
    except InvalidTransformError as error:
        return error


def faults() -> st.SearchStrategy[set[str]]:
    """The fault of a transform: mostly none, or one."""
    fault = st.sampled_from(("name", "nanosec", "norm", "slightly", "number", "rotation", "zero", "huge"))
    return st.just(set()) | st.sets(fault, min_size=1, max_size=1) | st.sets(fault, max_size=3)


@st.composite
def parts(draw: st.DrawFn) -> Part:
    """Transforms of which some are bad."""
    wrong = draw(faults())
    parent, child = draw(st.permutations((b"a", b"b", b"c", "ü".encode())))[:2]
    if "name" in wrong:
        child = draw(st.sampled_from((b"", b"/", b"/c", b"//d", parent, b"/" + parent)))
    elif draw(st.booleans()):
        child = draw(some.frame_names()).encode()
    sec = draw(st.integers(-(2**31), 2**31 - 1))
    nanosec = draw(st.integers(SECOND, 2**32 - 1) if "nanosec" in wrong else st.integers(0, SECOND - 1))
    drawn = draw(some.transforms())
    numbers = [*drawn.translation, *drawn.rotation]
    if "huge" in wrong:
        numbers[:3] = [1.7e308, 1.7e308, -1e308]
    if "norm" in wrong:
        factor = draw(st.floats(0.985, 1.015) | st.sampled_from((0.99, 1.01, 1e-200, 1e200)))
        numbers[3:] = [number * factor for number in numbers[3:]]
    if "slightly" in wrong:
        factor = 1.0 + draw(st.sampled_from((1e-16, 3e-16, 5e-16, 1e-15, 1e-14, 1e-8))) * draw(st.sampled_from((-1, 1)))
        numbers[3:] = [number * factor for number in numbers[3:]]
    if "zero" in wrong:
        numbers[3:] = [0.0, -0.0, 0.0, 0.0]
    if "number" in wrong:
        numbers[draw(st.integers(0, 2))] = draw(st.sampled_from(NOT_FINITE) | st.floats())
    if "rotation" in wrong:
        numbers[draw(st.integers(3, 6))] = draw(st.sampled_from(NOT_FINITE) | st.floats())
    x, y, z, i, j, k, w = numbers
    return Part(parent, child, sec, nanosec, (x, y, z, i, j, k, w))


@given(little_endian=st.booleans(), wanted=st.lists(parts(), max_size=6), bare_names=st.booleans(), known=st.booleans())
def test_each_transform_is_accepted_normalised_or_refused_as_by_the_classes(
    little_endian: bool, wanted: list[Part], bare_names: bool, known: bool
) -> None:
    order = "<" if little_endian else ">"
    if known:
        decode(message_of(*(Part(part.parent, part.child) for part in wanted), order=order), bare_names=bare_names)
    tags = [(f"sender {place}", place % 2 == 1) for place in range(len(wanted))]
    found = decode(message_of(*wanted, order=order), tags, bare_names=bare_names)
    errors = iter(found.errors)
    for part, tag, sample in zip(wanted, tags, found.samples, strict=True):
        answer = expected(part, tag, bare_names)
        if isinstance(answer, TransformStamped):
            assert bits(sample) == bits(answer)
            continue
        error = next(errors)
        assert sample is None
        assert error.reason == answer.reason
        assert error.authority == tag[0]
        if error.reason != "stamp":
            assert str(error) == str(answer)
    assert list(errors) == []


@pytest.mark.parametrize(
    ("bad", "reason", "parent", "child"),
    [
        (Part(nanosec=SECOND), "stamp", "map", "base"),
        (Part(child=b"\xff"), "frame name", "map", None),
        (Part(parent=b"caf\xe9"), "frame name", None, "base"),
        (Part(child=b"\xed\xa0\x80"), "frame name", "map", None),
        (Part(child=b"a" * (MAX_NAME + 1)), "frame name", "map", None),
        (Part(child=b""), "frame name", "map", ""),
        (Part(numbers=(0.0, 0.0, math.nan, 0.0, 0.0, 0.0, 1.0)), "not finite", "map", "base"),
        (Part(numbers=(0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0)), "not a unit quaternion", "map", "base"),
        (Part(numbers=(0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 1.0)), "not a unit quaternion", "map", "base"),
    ],
)
def test_a_bad_transform_is_refused_with_its_facts_and_its_neighbours_are_not(
    bad: Part, reason: str, parent: str | None, child: str | None
) -> None:
    tags = [("first", False), ("bad", True), ("last", True)]
    payload = message_of(Part(child=b"first"), bad, Part(child=b"last"))
    # From here on the names of `base` in `map` are known, at the alignment of a transform behind another.
    decode(message_of(Part(child=b"first"), Part()))
    for _ in range(2):
        samples, (error,) = decode(payload, tags)
        assert [sample and (sample.child, sample.authority) for sample in samples] == [
            ("first", "first"),
            None,
            ("last", "last"),
        ]
        assert (error.reason, error.parent, error.child, error.authority) == (reason, parent, child, "bad")


def test_a_refused_transform_keeps_nothing_of_the_message_alive() -> None:
    (error,) = decode(message_of(Part(child=b"\xff" * 100_000))).errors
    assert error.__traceback__ is None
    assert error.__context__ is None
    assert len(str(error)) < 200


# Payloads that are no message.


@pytest.mark.parametrize("samples", [[], [moving("map", "base", 0), moving("base", "arm", 1)]], ids=len)
def test_a_message_that_is_cut_anywhere_is_truncated(samples: list[TransformStamped]) -> None:
    payload = encode(samples)
    for length in range(len(payload)):
        assert reason_of(payload[:length]) == "truncated"


@pytest.mark.parametrize("header", ["0002", "0003", "0006", "0007", "0008", "0009", "000a", "000b", "0100", "0101"])
def test_parameter_lists_and_the_second_version_are_not_read(header: str) -> None:
    payload = encode([moving("map", "base", 0)])
    assert reason_of(bytes.fromhex(header) + payload[2:]) == "encoding"


@pytest.mark.parametrize("behind", [b"\1", b"\0\0\1", bytes(4), bytes(100_000), b"\0\0\0\0x"], ids=len)
def test_bytes_after_the_message_are_refused(behind: bytes) -> None:
    for samples in ([], [moving("map", "base", 0)]):
        assert reason_of(encode(samples) + behind) == "oversized"


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_string_ends_with_the_nul_that_its_length_counts(order: str) -> None:
    payload = message_of(Part(), order=order)
    assert decode(payload).errors == []
    for name in (b"map", b"base"):
        end = payload.index(name) + len(name)
        assert reason_of(payload[:end] + b"x" + payload[end + 1 :]) == "text"
    at = payload.index(b"base")
    for length in range(len(b"base")):
        assert reason_of(payload[: at - 4] + struct.pack(f"{order}I", length) + payload[at:]) == "text"


def test_the_least_message_of_many_transforms_is_long_enough() -> None:
    """Nothing that is counted can be smaller, so a count that does not fit is a lie."""
    for count in range(1, 5):
        payload = message_of(*[Part(b"", b"")] * count)
        assert len(payload) == 4 + 8 + count * MIN_SIZE
        assert [error.reason for error in decode(payload).errors] == ["frame name"] * count


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("count", [2, 1_000, 2**31, 2**32 - 1])
def test_a_false_count_allocates_no_memory(count: int, order: str) -> None:
    payload = message_of(Part(), order=order)
    payload = payload[:4] + struct.pack(f"{order}I", count) + payload[8:]
    assert reason_of(payload) == "truncated"
    tags = itertools.repeat(("", False))
    assert peak_of(lambda: reason_of(payload, tags)) < 100_000
    assert reason_of(payload[:60]) == "truncated"


@pytest.mark.parametrize("length", [100, 2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1])
@pytest.mark.parametrize("name", [b"map", b"base"])
def test_a_false_length_allocates_no_memory(name: bytes, length: int) -> None:
    payload = message_of(Part())
    at = payload.index(name)
    payload = payload[: at - 4] + struct.pack("<I", length) + payload[at:]
    assert reason_of(payload) == "truncated"
    assert peak_of(lambda: reason_of(payload)) < 100_000


@pytest.mark.parametrize("tags", [0, 1, 3])
def test_there_is_one_tag_for_each_transform(tags: int) -> None:
    payload = encode([moving("map", "base", 0), moving("base", "arm", 0)])
    assert reason_of(payload, [("odometry", False)] * tags) == "tags"
    assert reason_of(encode([]), [("odometry", False)]) == "tags"


def check(payload: bytes) -> None:
    """Nothing but the one error comes out, and what comes out of it is good."""
    try:
        samples, errors = decode(payload)
    except MalformedMessageError as error:
        assert error.reason in {"truncated", "oversized", "encoding", "text"}
        return
    assert samples.count(None) == len(errors)
    assert len(samples) * MIN_SIZE <= len(payload)
    for sample in samples:
        if sample is not None:
            assert refusal(sample) is None
            assert sample.replace() == sample


HEADERS = st.sampled_from((b"\0\0\0\0", b"\0\1\0\0")).flatmap(
    lambda order: st.integers(0, 3).map(lambda count: order + count.to_bytes(4, "little" if order[1] else "big"))
)


@given(begin=st.just(b"") | HEADERS, rest=st.binary(max_size=400), pad=st.integers(0, 300))
def test_random_bytes_do_no_harm(begin: bytes, rest: bytes, pad: int) -> None:
    check(begin + rest + bytes(pad))


@given(little_endian=st.booleans(), wanted=st.lists(parts(), min_size=1, max_size=4), data=st.data())
def test_a_damaged_message_does_no_harm(little_endian: bool, wanted: list[Part], data: st.DataObject) -> None:
    damaged = bytearray(message_of(*wanted, order="<" if little_endian else ">"))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(damaged) - 1))
        damaged[at] = data.draw(st.integers(0, 255) | st.just(damaged[at] ^ 1) | st.sampled_from((0, 255)))
    end = data.draw(st.integers(0, len(damaged)) | st.just(len(damaged)))
    check(bytes(damaged[:end]))


# Memory, and what is remembered.


@pytest.mark.thorough
def test_the_memory_for_thousands_of_names_is_released() -> None:
    for name in ("frame {}", "a" * 100 + "{}", "🦾" * 200 + "{}"):
        tracemalloc.start()
        try:
            for _ in range(10):
                samples = [moving("map", name.format(random.random()), 0) for _ in range(1_000)]
                assert decode(encode(samples)).samples == samples
            samples.clear()
            kept, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert kept < 3_000_000


@pytest.mark.parametrize("share", [copy.copy, copy.deepcopy, lambda error: pickle.loads(pickle.dumps(error))])
def test_the_error_copies_and_pickles(share: Callable[[MalformedMessageError], MalformedMessageError]) -> None:
    with pytest.raises(MalformedMessageError) as caught:
        decode(b"\0\1\0\0\1\0\0\0")
    twin = share(caught.value)
    assert type(twin) is MalformedMessageError
    assert (twin.reason, str(twin)) == ("truncated", str(caught.value))


def test_the_error_shows_the_fault() -> None:
    good = encode([moving("map", "base", 0)])
    with pytest.raises(MalformedMessageError, match=r"\(oversized\): 5 bytes behind the last transform$"):
        decode(good + bytes(5))
    with pytest.raises(MalformedMessageError, match=rf"\(truncated\): {len(good) - 5} bytes cannot hold 1 transforms$"):
        decode(good[:-1])
    with pytest.raises(MalformedMessageError, match=r"\(truncated\): 7 bytes$"):
        decode(good[:7])
    with pytest.raises(MalformedMessageError, match=r"\(text\): the string b'basex' does not end with NUL$"):
        decode(good.replace(b"base\0", b"basex"))
    with pytest.raises(MalformedMessageError, match=r"\(truncated\): 80 bytes cannot hold 4294967295 transforms"):
        decode(b"\0\1\0\0" + b"\xff" * 4 + bytes(76))
    with pytest.raises(MalformedMessageError, match=r"\(encoding\): it is not plain CDR, its header is 00 07 00 00$"):
        decode(b"\0\7\0\0" + bytes(76))

import copy
import pickle
import struct
from collections.abc import Callable

from hypothesis import given
from support import strategies as some
from support.samples import moving

from tfbus import SECOND, Buffer, Bus, SimulatedClock, TransformStamped
from tfbus.links._peers import Peer
from tfbus.links._provenance import Provenance, ReceivedTransform
from tfbus.tf_message import decode, encode

PROVENANCE = Provenance(b"0123456789abcdef", 7, None, Peer("other"))
SHARED: list[Callable[[TransformStamped], TransformStamped]] = [
    copy.copy,
    copy.deepcopy,
    *[lambda sample, n=n: pickle.loads(pickle.dumps(sample, n)) for n in range(2, pickle.HIGHEST_PROTOCOL + 1)],
]


def received(sample: TransformStamped) -> ReceivedTransform:
    """The same sample as if it had come over a link."""
    (twin,) = decode(encode([sample]), [(sample.authority, sample.static)], ReceivedTransform).samples
    assert twin is not None
    twin._provenance = PROVENANCE
    return twin


def bits(sample: TransformStamped) -> tuple[object, ...]:
    """Everything in a sample, with numbers that only a bit tells apart kept apart."""
    parent, child, stamp, row, authority, static = sample._fields
    return parent, child, stamp, struct.pack("<7d", *row), authority, static


@given(sample=some.samples(at=some.stamps(0, 2**31 * SECOND - 1)))
def test_a_received_sample_equals_one_that_never_was_on_a_link(sample: TransformStamped) -> None:
    twin = received(sample)
    assert twin == sample
    assert sample == twin
    assert {sample: 1}[twin] == 1
    assert {twin, sample} == {sample}
    assert (repr(twin), str(twin)) == (repr(sample), str(sample))
    assert isinstance(twin, TransformStamped)


def test_samples_that_differ_are_unequal_wherever_they_came_from() -> None:
    assert received(moving("map", "a", 1)) != moving("map", "a", 2)
    assert received(moving("map", "a", 1)) != "a"


@given(sample=some.samples(at=some.stamps(0, 2**31 * SECOND - 1)))
def test_a_copy_is_a_plain_sample_bit_for_bit(sample: TransformStamped) -> None:
    for share in SHARED:
        twin = share(received(sample))
        assert type(twin) is TransformStamped
        assert bits(twin) == bits(sample)


def test_a_quaternion_that_is_a_little_off_is_normalised_once_and_then_copied_as_it_is() -> None:
    message = bytearray(encode([moving("map", "a", 1)]))
    message[-32:] = struct.pack("<4d", 0.1, 0.2, 0.3, 0.93)
    (twin,) = decode(bytes(message), None, ReceivedTransform).samples
    assert twin is not None
    for share in SHARED:
        assert bits(share(twin)) == bits(twin)


def test_a_changed_sample_is_a_plain_one() -> None:
    changed = received(moving("map", "a", 1, 2.0, "odometry")).replace(stamp=5)
    assert type(changed) is TransformStamped
    assert changed == moving("map", "a", 5, 2.0, "odometry")


def test_the_answer_of_a_buffer_is_a_plain_sample() -> None:
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        bus.publish([received(moving("map", "a", 1))])
        assert type(buffer.lookup_nowait("map", "a", 1)) is TransformStamped

import pickle

from support.samples import moving

from tfbus.links._entries import MovingFrame, OutgoingBatch, RemovedFrame


def test_a_batch_has_its_origin_number_and_samples() -> None:
    batch = OutgoingBatch(b"o" * 16, 7, [moving("map", "a", 1)])
    assert (batch.origin, batch.sequence, batch.samples) == (b"o" * 16, 7, [moving("map", "a", 1)])


def test_what_is_said_of_a_frame_is_equal_if_it_is_the_same() -> None:
    assert RemovedFrame(b"o" * 16, 7, "a") == RemovedFrame(b"o" * 16, 7, "a", lost=False)
    assert RemovedFrame(b"o" * 16, 7, "a") != RemovedFrame(b"o" * 16, 7, "a", lost=True)
    assert pickle.loads(pickle.dumps(MovingFrame("a"))) == MovingFrame("a") != MovingFrame("b")

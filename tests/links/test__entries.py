import pickle
import pkgutil
from dataclasses import FrozenInstanceError, fields, is_dataclass
from importlib import import_module

import pytest
from support.samples import moving

from tfbus import links
from tfbus.links._entries import MovingFrame, OutgoingBatch, RemovedFrame
from tfbus.links._inbox import ReceivedMessage
from tfbus.links._outbox import Turn


def test_a_batch_has_its_origin_number_and_samples() -> None:
    batch = OutgoingBatch(b"o" * 16, 7, [moving("map", "a", 1)])
    assert (batch.origin, batch.sequence, batch.samples) == (b"o" * 16, 7, [moving("map", "a", 1)])


def test_what_is_said_of_a_frame_is_equal_if_it_is_the_same() -> None:
    assert RemovedFrame(b"o" * 16, 7, "a") == RemovedFrame(b"o" * 16, 7, "a", lost=False)
    assert RemovedFrame(b"o" * 16, 7, "a") != RemovedFrame(b"o" * 16, 7, "a", lost=True)
    assert pickle.loads(pickle.dumps(MovingFrame("a"))) == MovingFrame("a") != MovingFrame("b")


def test_what_links_hand_on_has_slots_and_cannot_be_changed_but_for_what_gathers() -> None:
    modules = [name for _, name, _ in pkgutil.iter_modules(links.__path__) if name.startswith("_")]
    kinds = {
        kind
        for name in modules
        for kind in vars(import_module(f"tfbus.links.{name}")).values()
        if isinstance(kind, type) and is_dataclass(kind)
    }
    assert len(kinds) > 12
    for kind in kinds:
        value = kind.__new__(kind)
        assert not hasattr(value, "__dict__"), kind
        if kind not in (Turn, ReceivedMessage) and not kind.__name__.startswith("_"):
            with pytest.raises(FrozenInstanceError):
                setattr(value, fields(kind)[0].name, 0)

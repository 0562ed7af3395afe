"""The steps of a scenario: samples and questions, in order, each a small dict that JSON can hold.

A step's first key says what is done, its value holds the arguments. The recorder adds ``"tf2"``, the real answer.
Where tfbus differs on purpose the step names the deviation and says what tfbus answers instead.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

LATEST = "LATEST"
SECOND = 1_000_000_000

Step = dict[str, Any]
Stamp = int | str
Numbers = Sequence[float]

UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Scenario:
    """Steps on one fresh tree that keeps some seconds of history."""

    name: str
    steps: list[Step]
    keep: float = 10.0


def sample(
    parent: str, child: str, stamp: int, translation: Numbers | float = 0.0, rotation: Numbers = UPRIGHT
) -> Step:
    """Insert a moving sample; a number is how far it is along x."""
    return {"insert": [parent, child, stamp, _vector(translation), list(rotation)]}


def static(
    parent: str, child: str, translation: Numbers | float = 0.0, rotation: Numbers = UPRIGHT, stamp: int = 0
) -> Step:
    """Insert a static sample."""
    return {"insert static": [parent, child, stamp, _vector(translation), list(rotation)]}


def _vector(translation: Numbers | float) -> list[float]:
    return [float(translation), 0.0, 0.0] if isinstance(translation, (int, float)) else list(translation)


def lookup(target: str, source: str, at: Stamp = LATEST) -> Step:
    """A question for the pose of source, seen from target."""
    return {"lookup": [target, source, at]}


def travel(target: str, source: str, at: Stamp, source_at: Stamp, fixed: str) -> Step:
    """A question for the pose of source at its own stamp, seen from target at another, through a fixed frame."""
    return {"lookup": [target, source, at, source_at, fixed]}


def can(target: str, source: str, at: Stamp = LATEST) -> Step:
    """Whether a lookup has an answer."""
    return {"can": [target, source, at]}


def can_travel(target: str, source: str, at: Stamp, source_at: Stamp, fixed: str) -> Step:
    """Whether a lookup through a fixed frame has an answer."""
    return {"can": [target, source, at, source_at, fixed]}


def latest(target: str, source: str) -> Step:
    """The newest stamp that all edges between two frames have reached."""
    return {"latest": [target, source]}


def chain(target: str, source: str, at: Stamp = LATEST) -> Step:
    """The frames between two frames."""
    return {"chain": [target, source, at]}


def parent(frame: str) -> Step:
    """The frame that another one hangs on by its newest sample."""
    return {"parent": [frame]}


def known(frame: str) -> Step:
    """Whether a frame exists."""
    return {"known": [frame]}


def frames() -> Step:
    """All names, sorted."""
    return {"frames": []}


def clear() -> Step:
    """Drop what moves."""
    return {"clear": []}


def bag(name: str, shift: int) -> Step:
    """Insert every transform that a bag holds, stamped a number of whole seconds earlier."""
    return {"bag": [name, shift]}


def deviates(step: Step, deviation: str, tfbus: Any) -> Step:
    """The same step, where tfbus gives another answer on purpose."""
    return {**step, "deviation": deviation, "tfbus": tfbus}


def placed(stamp: int, translation: Numbers | float = 0.0, rotation: Numbers = UPRIGHT) -> list[Any]:
    """The answer of a lookup: a stamp and a transform."""
    return [stamp, _vector(translation), list(rotation)]


def verb_of(step: Step) -> str:
    """The kind of a step."""
    return next(iter(step))

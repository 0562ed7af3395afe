"""The arguments of a lookup, as one value."""

from dataclasses import dataclass

from tfbus.data import Stamped, check_registered
from tfbus.stamps import Latest
from tfbus.tree.policy import Policy


@dataclass(frozen=True, slots=True)
class Question:
    """The arguments of a lookup: stamps in ns, `max_age` in s."""

    target: str
    source: str
    at: int | Latest
    source_at: int | Latest | None = None
    fixed: str | None = None
    max_age: float | None = None
    policy: Policy | None = None

    @property
    def is_plain(self) -> bool:
        """Whether it asks for nothing but a stamp, so that the kernel may answer it."""
        return self.source_at is None and self.fixed is None and self.max_age is None and self.policy is None


def question_of(
    data: Stamped, target: str, at: int | Latest | None, fixed: str | None, max_age: float | None, policy: Policy | None
) -> Question:
    """The question whose answer moves `data`; the arguments are those of `Buffer.transform`.

    Raises
    ------
    TypeError
        If `data` are of a type that is not registered or has no frame and stamp, or only one of `at` and `fixed` is
        given.
    """
    check_registered(data)
    if not (hasattr(data, "frame") and hasattr(data, "stamp")):
        kind = type(data).__name__
        raise TypeError(f"a {kind} has no frame and stamp of its own: look the transform up and call do_transform")
    if at is None and fixed is None:
        return Question(target, data.frame, data.stamp, max_age=max_age, policy=policy)
    if at is None or fixed is None:
        raise TypeError("at and fixed go together: the data at their stamp, carried to `at` through the fixed frame")
    return Question(target, data.frame, at, data.stamp, fixed, max_age, policy)

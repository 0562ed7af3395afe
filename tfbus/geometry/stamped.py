"""`TransformStamped`, a transform between two frames at an instant, and batches of such samples."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, TypedDict, Unpack

from tfbus.errors import InvalidTransformError
from tfbus.frames import check_frame
from tfbus.geometry.transform import Transform, from_row
from tfbus.plain import StampsAs, from_fields, printable, schema_of, with_text
from tfbus.rows import Row
from tfbus.stamps import STAMP_MAX, STAMP_MIN, StampLike, as_stamp, format_duration, format_stamp, is_real
from tfbus.tf2_names import says_ours
from tfbus.which_kernel import compose_rows, invert_row, kernel

if kernel == "python":
    from tfbus._python_kernel import Sample
else:
    from tfbus._kernel import Sample

Fields = tuple[str, str, int, Row, str, bool]

_KINDS = {"parent": str, "child": str, "stamp": int, "transform": Transform, "authority": str, "static": bool}

_POLICY_KINDS = {"extrapolated_by": int, "gap": int}


class Changes(TypedDict, total=False):
    """The fields of a `TransformStamped`, as `TransformStamped.replace` takes them."""

    parent: str
    child: str
    stamp: StampLike
    transform: Transform
    authority: str
    static: bool


_NO_BEGINNING = ("", "/")
"""The first characters of strings that are not frame names."""


@says_ours
class TransformStamped(Sample):
    """A transform with its two frames and its stamp: a published sample, or the answer of a lookup. Immutable.

    Parameters
    ----------
    parent, child : str
        The transform maps `child` coordinates into `parent`. In an answer they are target and source.
    stamp : int
        Nanoseconds.
    transform : Transform
    authority : str
        The sender; shown in errors and tools.
    static : bool
        Whether it holds at every stamp. An answer is static when its whole path is.

    Raises
    ------
    InvalidTransformError
        If a name is empty or starts with ``/``, child equals parent, or the stamp does not fit 64 bits.
    TypeError
        If an argument has the wrong type; a float stamp is the usual one.

    Examples
    --------
    >>> TransformStamped("map", "cart", from_seconds(1.5), Transform((1.0, 2.0, 0.0)), authority="odometry").stamp
    1500000000
    """

    __slots__ = ()
    _is_plain = True
    """Whether it knows nothing beyond its fields. The kernel hands other samples back."""
    __match_args__ = ("parent", "child", "stamp", "transform", "authority", "static")

    def __init__(
        self,
        parent: str,
        child: str,
        stamp: StampLike,
        transform: Transform,
        authority: str = "",
        static: bool = False,
    ) -> None:
        if (
            type(parent) is type(child) is type(authority) is str
            and parent[:1] not in _NO_BEGINNING
            and child[:1] not in _NO_BEGINNING
            and parent != child
            and type(stamp) is int
            and STAMP_MIN <= stamp <= STAMP_MAX
            and type(transform) is Transform
        ):
            # The usual case. The same checks with their errors, below, take three times as long.
            self._fields = parent, child, stamp, transform._row, authority, bool(static)
            return
        for name in (parent, child):
            check_frame(name, parent, child, authority)
        if parent == child:
            raise InvalidTransformError(
                f"frame {child!r} cannot be its own parent",
                reason="self transform",
                parent=parent,
                child=child,
                authority=authority,
            )
        if not isinstance(transform, Transform):
            raise TypeError(f"transform must be a Transform, not {transform!r}")
        if not isinstance(authority, str):
            raise TypeError(f"authority must be a str, not {authority!r}")
        try:
            stamp = as_stamp(stamp)
        except ValueError as error:
            raise InvalidTransformError(
                str(error), reason="stamp", parent=parent, child=child, authority=authority
            ) from None
        self._fields = parent, child, stamp, transform._row, authority, bool(static)

    @property
    def frame(self) -> str:
        """The frame in which the pose of `child` is expressed: the same as `parent`, as in other stamped data."""
        return self.parent

    @property
    def transform(self) -> Transform:
        """Maps `child` coordinates into `parent`."""
        return from_row(self._row)

    @property
    def extrapolated_by(self) -> int:
        """The time in ns from an extrapolated answer to the sample it was taken from; within the policy's limit."""
        return 0

    @property
    def gap(self) -> int | None:
        """The time in ns between the samples that an answer was interpolated from; None without a policy."""
        return None

    def replace(self, **changes: Unpack[Changes]) -> TransformStamped:
        """A copy with some fields changed; all fields are checked again.

        Examples
        --------
        >>> TransformStamped("map", "cart", 0, Transform()).replace(child="trailer").child
        'trailer'
        """
        parent, child, stamp, row, authority, static = self._fields
        fields: Changes = {
            "parent": parent,
            "child": child,
            "stamp": stamp,
            "transform": from_row(row),
            "authority": authority,
            "static": static,
        }
        fields.update(changes)
        return TransformStamped(**fields)

    __replace__ = replace

    def _take(self, other: Any) -> None:
        """Take over what a subclass knows beyond the fields."""

    def to_dict(self, *, stamps: StampsAs = "int") -> dict[str, Any]:
        """Plain data for JSON: ``"type"``, and the parameters under their names; the stamp is an ``int`` of ns.

        With ``stamps="text"`` it is text, for programs in JavaScript, whose numbers are not exact beyond 2**53.

        Examples
        --------
        >>> TransformStamped("map", "cart", 10, Transform()).to_dict(stamps="text")["stamp"]
        '10'
        """
        parent, child, stamp, row, authority, static = self._fields
        values = {
            "type": "TransformStamped",
            "parent": parent,
            "child": child,
            "stamp": stamp,
            "transform": from_row(row).to_dict(),
            "authority": authority,
            "static": static,
        }
        return values if stamps == "int" else with_text(values, stamps)

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: Any, handler: Any) -> Any:
        defaults = {"type": None, "authority": "", "static": False, **dict.fromkeys(_POLICY_KINDS)}
        return schema_of(TransformStamped, {**_KINDS, **_POLICY_KINDS}, defaults, handler)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> TransformStamped:
        """The sample or answer from which `to_dict` made `data`.

        Raises
        ------
        ValueError
            If the data do not describe a `TransformStamped`. The message names the field.

        Examples
        --------
        >>> sample = TransformStamped("map", "cart", 10, Transform())
        >>> TransformStamped.from_dict(sample.to_dict()) == sample
        True
        """
        kinds = _KINDS if "gap" not in data else {**_KINDS, **_POLICY_KINDS}
        fields = from_fields(TransformStamped, data, kinds)
        policy_use = fields.pop("extrapolated_by", None), fields.pop("gap", None)
        target, source = fields["parent"], fields["child"]
        if target == source:
            # The answer of a lookup may have the same frame twice; a sample may not.
            fields["child"] = f"{target}'"
        answer = renamed(TransformStamped(**fields), target, source)
        if None in policy_use:
            return answer
        _, _, stamp, row, _, static = answer._fields
        return qualified_answer(target, source, stamp, row, static, *policy_use)

    def inverse(self) -> TransformStamped:
        """The transform in the other direction, with the names of the two frames exchanged; also as ``~t``.

        Examples
        --------
        >>> (~TransformStamped("map", "base", 0, Transform((2.0, 0.0, 0.0)))).parent
        'base'
        """
        parent, child, stamp, row, _, static = self._fields
        return answer_of(child, parent, stamp, invert_row(row), static)

    def __invert__(self) -> TransformStamped:
        return self.inverse()

    def __matmul__(self, other: TransformStamped) -> TransformStamped:
        """Compose two transforms whose frames meet: ``map_from_base @ base_from_laser``.

        Raises
        ------
        ValueError
            If the child of the left one is not the parent of the right one, or both move and their stamps differ.

        Examples
        --------
        >>> map_from_base = TransformStamped("map", "base", 5_000_000_000, Transform((2.0, 0.0, 0.0)))
        >>> base_from_laser = TransformStamped("base", "laser", 0, Transform((0.1, 0.0, 0.2)), static=True)
        >>> print(map_from_base @ base_from_laser)
        map <- laser at 5.000 s: Transform(translation=(2.1, 0.0, 0.2), rotation=(0.0, 0.0, 0.0, 1.0))
        """
        if not isinstance(other, TransformStamped):
            return NotImplemented
        if self.child != other.parent:
            raise ValueError(
                f"the frames do not meet: {self.parent!r} <- {self.child!r} @ {other.parent!r} <- {other.child!r}"
            )
        stamp = other.stamp if self.static else self.stamp
        if not (self.static or other.static or self.stamp == other.stamp):
            raise ValueError(
                f"{self.parent!r} <- {self.child!r} is at {format_stamp(self.stamp)}, and {other.parent!r} <- "
                f"{other.child!r} at {format_stamp(other.stamp)}: look both up at one stamp"
            )
        row = compose_rows(self._row, other._row)
        return answer_of(self.parent, other.child, stamp, row, self.static and other.static)

    def __eq__(self, other: object) -> bool:
        return self._fields == other._fields if isinstance(other, TransformStamped) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._fields)

    def __repr__(self) -> str:
        parent, child, stamp, row, authority, static = self._fields
        extra = (f", authority={authority!r}" if authority else "") + (", static=True" if static else "")
        return f"TransformStamped({parent!r}, {child!r}, {stamp}, {from_row(row)}{extra})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), self._fields), getattr(self, "__dict__", None)

    def __str__(self) -> str:
        when = "static" if self.static else f"at {format_stamp(self.stamp)}"
        return f"{printable(self.parent)} <- {printable(self.child)} {when}: {self.transform}"


class QualifiedTransform(TransformStamped):
    """The answer of a lookup with a policy, with the extrapolation and the gap that it used."""

    __slots__ = ("_policy_use",)
    _policy_use: tuple[int, int]

    @property
    def extrapolated_by(self) -> int:
        """The time in ns from the stamp to the sample that was used in its place, on the edge where it is longest."""
        return self._policy_use[0]

    @property
    def gap(self) -> int:
        """The time in ns between two samples that were interpolated, on the edge where it is longest."""
        return self._policy_use[1]

    def _take(self, other: Any) -> None:
        self._policy_use = other._policy_use

    def to_dict(self, *, stamps: StampsAs = "int") -> dict[str, Any]:
        """As `TransformStamped.to_dict`, with ``"extrapolated_by"`` and ``"gap"`` in ns."""
        return {**super().to_dict(stamps=stamps), "extrapolated_by": self.extrapolated_by, "gap": self.gap}

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), self._fields, self._policy_use), getattr(self, "__dict__", None)

    def __str__(self) -> str:
        remark = f", extrapolated by {format_duration(self.extrapolated_by)}" if self.extrapolated_by else ""
        return super().__str__() + remark


def answer_of(target: str, source: str, stamp: int, row: Row, static: bool) -> TransformStamped:
    """The answer of a lookup, made of valid parts; nothing is checked."""
    sample = TransformStamped.__new__(TransformStamped)
    sample._fields = target, source, stamp, row, "", static
    return sample


def qualified_answer(
    target: str, source: str, stamp: int, row: Row, static: bool, extrapolated_by: int, gap: int
) -> QualifiedTransform:
    """As `answer_of`, with the extrapolation and the gap that a policy allowed."""
    sample = QualifiedTransform.__new__(QualifiedTransform)
    sample._fields = target, source, stamp, row, "", static
    sample._policy_use = extrapolated_by, gap
    return sample


def renamed(answer: TransformStamped, target: str, source: str) -> TransformStamped:
    """An answer with other names for its two frames."""
    copy = type(answer).__new__(type(answer))
    copy._fields = target, source, *answer._fields[2:]
    if type(answer) is not TransformStamped:
        copy._take(answer)
    return copy


def _restored(kind: type[TransformStamped], fields: Fields, policy_use: tuple[int, int] | None = None) -> Any:
    """A sample that was copied or pickled."""
    sample = kind.__new__(kind)
    sample._fields = fields
    if isinstance(sample, QualifiedTransform) and policy_use is not None:
        sample._policy_use = policy_use
    return sample


Batch = tuple[TransformStamped, ...]
"""Samples that were published together: a subscriber sees all of them or none."""


def as_batch(samples: TransformStamped | Iterable[TransformStamped]) -> Batch:
    """One sample or an iterable of them, as a tuple.

    Raises
    ------
    TypeError
        If an element is not a `TransformStamped`. The message shows it.
    """
    if isinstance(samples, TransformStamped):
        return (samples,)
    if isinstance(samples, (str, bytes, Mapping)) or not isinstance(samples, Iterable):
        raise TypeError(f"expected a TransformStamped or an iterable of them, not {samples!r}{_instead(samples)}")
    batch = tuple(samples)
    for sample in batch:
        if not isinstance(sample, TransformStamped):
            raise TypeError(f"expected a TransformStamped, not {sample!r}{_instead(sample)}")
    return batch


def _instead(thing: object) -> str:
    """The advice for something that is no sample but looks like a message of ROS or a transform; else empty."""
    fields = thing.keys() if isinstance(thing, Mapping) else dir(thing)
    if "child_frame_id" in fields:
        return ": convert a ROS message with from_message first"
    if "transforms" in fields:
        return ": convert each of a message's transforms with from_message first"
    return ": a TransformStamped has its frames and its stamp too" if isinstance(thing, Transform) else ""


MAX_TRANSLATION = 1e12
"""The default bound on the magnitude of a translation, in m: about six times the way to Saturn."""
GREATEST_BOUND = 1e100
"""The greatest bound, in m. The square of a translation, and the sum along any path, are finite below it."""


def as_max_translation(bound: float) -> float:
    """The argument `max_translation`, in m, as a float.

    Raises
    ------
    TypeError
        If it is not a real number.
    ValueError
        If it is not greater than zero, or greater than 1e100.
    """
    if not is_real(bound):
        raise TypeError(f"max_translation must be a number in m, not {bound!r}")
    if not 0.0 < bound <= GREATEST_BOUND:
        raise ValueError(f"max_translation must be greater than 0 and at most {GREATEST_BOUND:g} m, got {bound!r}")
    return float(bound)


def is_within(sample: TransformStamped, bound: float) -> bool:
    """Whether the translation of a sample is finite, and no longer than `bound` in m."""
    # The square is faster; it can disagree with the magnitude only near the bound.
    return sample._square < 0.99 * bound * bound or math.hypot(*sample._row[:3]) <= bound


def check_translations(batch: Batch, bound: float) -> None:
    """Raise `InvalidTransformError` for the first sample whose translation is longer than `bound` in m."""
    for sample in batch:
        if not is_within(sample, bound):
            raise not_physical(sample, bound)


def not_physical(sample: TransformStamped, bound: float) -> InvalidTransformError:
    """The error of a sample that is not within the bound, in m.

    Its reason is ``"not physical"``; or ``"not finite"``, because the product of two transforms may be infinite.
    """
    parent, child, _, row, authority, _ = sample._fields
    length = math.hypot(*row[:3])
    if all(map(math.isfinite, row[:3])):
        why, reason = f"{length:.6g} m long, which is not physical (at most {bound:g} m)", "not physical"
    else:
        why, reason = "not finite", "not finite"
    sender = f", from {authority!r}" if authority else ""
    return InvalidTransformError(
        f"the translation of {child!r} in {parent!r} is {why}{sender}",
        reason=reason,
        parent=parent,
        child=child,
        authority=authority,
    )


def shifted(sample: TransformStamped, nanoseconds: int) -> TransformStamped:
    """A sample with its stamp moved; a static one is returned itself, because it holds at every stamp.

    Raises
    ------
    InvalidTransformError
        If the stamp does not fit 64 bits then.
    """
    parent, child, stamp, row, authority, static = sample._fields
    if static:
        return sample
    stamp += nanoseconds
    if not STAMP_MIN <= stamp <= STAMP_MAX:
        why = f"the stamp of frame {child!r} and the offset of its source do not fit 64 bits"
        raise InvalidTransformError(why, reason="stamp", parent=parent, child=child, authority=authority)
    kind = TransformStamped if sample._is_plain else type(sample)
    moved = kind.__new__(kind)
    moved._fields = parent, child, stamp, row, authority, static
    moved._take(sample)
    return moved

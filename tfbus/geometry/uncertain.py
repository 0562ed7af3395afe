"""`UncertainSample`, a sample that says how large its error is, and how that is related to the errors around it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Unpack

from tfbus.geometry.covariance import Covariance, Kind, as_covariance, as_kind, covariance_of, inverse_jacobian
from tfbus.geometry.stamped import Changes, TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.plain import StampsAs
from tfbus.stamps import StampLike


class Belief(NamedTuple):
    """The error of one sample of an edge."""

    covariance: Covariance
    kind: Kind


class UncertainSample(TransformStamped):
    """A sample with the covariance of its error.

    Parameters
    ----------
    parent, child, stamp, transform, authority, static
        As `TransformStamped`.
    covariance : Covariance
        Along the axes of `parent`.
    kind : {"independent", "drift", "constant"}
        How the errors of this edge at two stamps are related: ``"independent"`` of each other, as of a marker that is
        seen anew each time; as a ``"drift"``, to which each motion adds its own error, as of odometry; or one
        ``"constant"`` error, as of a calibration. Samples of different kinds count as independent.

    Raises
    ------
    InvalidTransformError, TypeError
        As `TransformStamped`.
    ValueError
        If the kind is another.

    Notes
    -----
    Equality compares the fields of the sample only.

    Examples
    --------
    >>> error = Covariance.of(xyz=0.01, rpy=0.002)
    >>> UncertainSample("odom", "base_link", 0, Transform(), "odometry", covariance=error, kind="drift").kind
    'drift'
    """

    __slots__ = ("belief",)
    belief: Belief
    _is_plain = False

    def __init__(
        self,
        parent: str,
        child: str,
        stamp: StampLike,
        transform: Transform,
        authority: str = "",
        static: bool = False,
        *,
        covariance: Covariance,
        kind: Kind = "independent",
    ) -> None:
        super().__init__(parent, child, stamp, transform, authority, static)
        self.belief = Belief(as_covariance(covariance), as_kind(kind))

    @property
    def covariance(self) -> Covariance:
        """Of the error of the child's origin and a small rotation, along the axes of the parent."""
        return self.belief.covariance

    @property
    def kind(self) -> Kind:
        """The relation of the errors of this edge at two stamps."""
        return self.belief.kind

    def replace(self, **changes: Unpack[Changes]) -> UncertainSample:
        """As `TransformStamped.replace`; the covariance stays.

        Examples
        --------
        >>> sample = UncertainSample("map", "cart", 0, Transform(), covariance=Covariance.of(xyz=0.1))
        >>> sample.replace(stamp=10).covariance == sample.covariance
        True
        """
        return with_belief(super().replace(**changes), self.belief)

    __replace__ = replace

    def _take(self, other: Any) -> None:
        self.belief = other.belief

    def inverse(self) -> UncertainSample:
        """The sample in the other direction, with the names of the two frames exchanged; also as ``~t``.

        The errors of a drift become independent ones, which says less: seen from the body, the motion that adds an
        error does not carry the older ones along.

        Examples
        --------
        >>> error = Covariance.of(rpy=(0.0, 0.0, 0.1))
        >>> sample = UncertainSample("odom", "base", 0, Transform((2.0, 0.0, 0.0)), covariance=error, kind="drift")
        >>> (~sample).covariance.sigmas.round(9).tolist(), (~sample).kind
        ([0.0, 0.2, 0.0, 0.0, 0.0, 0.1], 'independent')
        """
        jacobian = inverse_jacobian(self.transform)
        covariance = covariance_of(jacobian @ self.covariance.matrix @ jacobian.T)
        kind: Kind = "independent" if self.kind == "drift" else self.kind
        return with_belief(super().inverse(), Belief(covariance, kind))

    def to_dict(self, *, stamps: StampsAs = "int") -> dict[str, Any]:
        """As `TransformStamped.to_dict`, with ``"covariance"``, 36 numbers row by row, and ``"kind"``.

        Examples
        --------
        >>> UncertainSample("map", "cart", 0, Transform(), covariance=Covariance.of(xyz=0.1)).to_dict()["kind"]
        'independent'
        """
        return {**super().to_dict(stamps=stamps), "covariance": self.covariance.to_dict(), "kind": self.kind}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> UncertainSample:
        """The sample from which `to_dict` made `data`.

        Raises
        ------
        ValueError
            As `TransformStamped.from_dict`; or if there is no valid covariance and kind.

        Examples
        --------
        >>> sample = UncertainSample("map", "cart", 0, Transform(), covariance=Covariance.of(xyz=0.1))
        >>> UncertainSample.from_dict(sample.to_dict()).covariance == sample.covariance
        True
        """
        fields = {name: value for name, value in data.items() if name not in ("covariance", "kind")}
        covariance, kind = Covariance(data.get("covariance", ())), as_kind(data.get("kind", "independent"))
        return with_belief(super().from_dict(fields), Belief(covariance, kind))

    def __reduce__(self) -> tuple[Any, ...]:
        return with_belief, (TransformStamped(*self._parts()), self.belief), getattr(self, "__dict__", None)

    def _parts(self) -> tuple[Any, ...]:
        return self.parent, self.child, self.stamp, self.transform, self.authority, self.static

    def __repr__(self) -> str:
        known = super().__repr__().removeprefix("TransformStamped").removesuffix(")")
        return f"UncertainSample{known}, covariance={self.covariance!r}, kind={self.kind!r})"


def are_uncertain(samples: Iterable[TransformStamped]) -> bool:
    """Whether one of some samples has a covariance."""
    # A loop, because it takes half the time of `any`.
    for sample in samples:  # noqa: SIM110
        if not sample._is_plain:
            return True
    return False


def with_belief(sample: TransformStamped, belief: Belief) -> UncertainSample:
    """A sample with a covariance and a kind."""
    found = UncertainSample.__new__(UncertainSample)
    found._fields = sample._fields
    found.belief = belief
    return found

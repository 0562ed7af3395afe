"""The fields of a stamped transform, for Python without the compiled kernel."""

from tfbus.geometry.rows import Row


class Sample:
    """The fields of a stamped transform; the base of `TransformStamped`."""

    # One slot, because the hot paths read all six fields at once.
    __slots__ = ("_fields",)
    _fields: tuple[str, str, int, Row, str, bool]

    @property
    def parent(self) -> str:
        """The frame that the transform maps into; the target, in an answer."""
        return self._fields[0]

    @property
    def child(self) -> str:
        """The frame that the transform maps from; the source, in an answer."""
        return self._fields[1]

    @property
    def stamp(self) -> int:
        """Nanoseconds; never `LATEST`."""
        return self._fields[2]

    @property
    def _row(self) -> Row:
        return self._fields[3]

    @property
    def _square(self) -> float:
        x, y, z, _, _, _, _ = self._fields[3]
        return x * x + y * y + z * z

    @property
    def authority(self) -> str:
        """The sender; empty in an answer."""
        return self._fields[4]

    @property
    def static(self) -> bool:
        """Whether it holds at every stamp."""
        return self._fields[5]

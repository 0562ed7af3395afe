"""`Edits`, what a conversion changes in the transforms of a recording."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from tfbus.errors import InvalidTransformError
from tfbus.frames import check_frame
from tfbus.recording.formats._raw_transforms import RawTransform


@dataclass(frozen=True, slots=True)
class Edits:
    """The changes that `convert` makes to transforms; numbers and stamps stay.

    Parameters
    ----------
    frames : collection of str, optional
        Only the transforms of these child frames stay, by the names in the recording.
    rename : mapping of str to str
        New names of frames.
    prefix : str
        Put before the names of all frames that are not renamed.
    drop_static : bool
        Whether static transforms are left out.

    Raises
    ------
    ValueError
        If a new name or the prefix is empty or starts with a slash; an empty prefix is none.
    """

    frames: Collection[str] | None = None
    rename: Mapping[str, str] = field(default_factory=dict)
    prefix: str = ""
    drop_static: bool = False

    def __post_init__(self) -> None:
        try:
            for name in (*self.rename.values(), *((self.prefix,) if self.prefix else ())):
                check_frame(name)
        except InvalidTransformError as error:
            raise ValueError(str(error)) from None

    @property
    def changes_messages(self) -> bool:
        """Whether messages with transforms change; static ones that are left out do not count."""
        return self.frames is not None or bool(self.rename) or bool(self.prefix)

    def keeps(self, transform: RawTransform) -> bool:
        """Whether a transform stays."""
        return self.frames is None or _bare(transform.child) in self.frames

    def apply(self, transform: RawTransform) -> RawTransform:
        """A transform with the new names of its frames."""
        if not (self.rename or self.prefix):
            return transform
        return transform._replace(parent=self._rename(transform.parent), child=self._rename(transform.child))

    def _rename(self, name: bytes) -> bytes:
        bare = _bare(name)
        new = self.rename.get(bare, self.prefix + bare)
        return name if new == bare else new.encode(errors="surrogateescape")


def _bare(name: bytes) -> str:
    return name.decode(errors="surrogateescape").lstrip("/")

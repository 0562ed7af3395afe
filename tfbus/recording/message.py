"""`RecordedMessage`, one message of a recording."""

from typing import NamedTuple

from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import Batch
from tfbus.tf_message import MalformedMessageError


class RecordedMessage(NamedTuple):
    """The transforms of one message of a recording."""

    received: int
    """The log time in ns: the time of recording, not a stamp."""
    batch: Batch
    """The valid transforms."""
    errors: tuple[InvalidTransformError | MalformedMessageError, ...]
    """The reason why others were refused; with ``"damaged"``, the part of the file that is lost here, and with
    ``"unfinished"``, why messages may be missing at the end."""

    @property
    def is_report(self) -> bool:
        """Whether it stands for no message of the file, but for what is missing there."""
        return any(error.reason in ("damaged", "unfinished") for error in self.errors)

"""`examine`, which finds the faults of a recording."""

import math
import struct
from collections.abc import Callable
from contextlib import suppress

from tfbus.analysis.examiner import Examiner, Finding, Limits
from tfbus.recording.formats.storage import Channel
from tfbus.recording.formats.transforms import RawTransform, bounded, parser_of
from tfbus.recording.recording import Block, Recording
from tfbus.stamps import SECOND
from tfbus.tf_message import MalformedMessageError

_ROTATION = struct.Struct("<4d")


def examine(
    recording: Recording,
    limits: Limits | None = None,
    since: int | None = None,
    until: int | None = None,
    *,
    progress: Callable[[int], object] | None = None,
) -> list[Finding]:
    """Examine all transforms of a recording in the order of their arrival.

    Parameters
    ----------
    recording : Recording
    limits : Limits, optional
    since, until : int, optional
        The first and the last log time, in ns.
    progress : callable, optional
        Called with the number of messages in each block that has been read.

    Returns
    -------
    list of Finding
        Empty if nothing is wrong.

    Examples
    --------
    >>> from tfbus.recording import examine, open_recording
    >>> with open_recording("small.bag") as recording:
    ...     print(sorted({finding.kind for finding in examine(recording)}))
    ['disconnected', 'gap', 'refused', 'rotation', 'stamps go back', 'two parents']
    """
    examiner = Examiner(limits)
    unfinished: list[Finding] = []
    parsers: dict[Channel, Callable[[bytes], list[RawTransform]]] = {}
    for block in recording.blocks(since, until):
        if isinstance(block, Block):
            for _, channel, payload in block.stored:
                if isinstance(channel, Channel):
                    parse = parsers.setdefault(channel, parser_of(channel))
                    with suppress(MalformedMessageError):
                        _note_norms(examiner, parse(bounded(payload)))
        for received, batch, errors in block.messages():
            examiner.add(batch, received)
            for error in errors:
                if isinstance(error, MalformedMessageError) and error.reason == "unfinished":
                    unfinished.append(Finding("unfinished", None, 1, None, None, "", error.detail))
                else:
                    examiner.add_refused((error.reason,))
        if progress is not None:
            progress(len(block))
    return unfinished + examiner.findings()


def _note_norms(examiner: Examiner, transforms: list[RawTransform]) -> None:
    for seconds, nanoseconds, _, child, numbers in transforms:
        norm = math.hypot(*_ROTATION.unpack_from(numbers, 24))
        # A number that is not finite is refused anyway.
        if math.isfinite(norm):
            name = child.decode(errors="replace").lstrip("/")
            examiner.add_norm(name, seconds * SECOND + nanoseconds, norm)

"""Asks the real tf2: Debian's `tf2_py`, without a ROS master.

An answer is what tf2 returned, or the name of what it raised; an extrapolation says besides which side it was on, which
only tf2's message tells. An insertion's answer is the code that tf2 logs when it refuses, because it returns nothing.
"""

import os
import re
import tempfile
from collections import Counter
from typing import Any

import rospy  # type: ignore[import-not-found]
import tf2_py  # type: ignore[import-not-found]
from bags import transforms_in
from geometry_msgs.msg import TransformStamped  # type: ignore[import-not-found]
from steps import LATEST, SECOND, Scenario, Stamp, Step, verb_of

DIGITS = 11


def record(scenario: Scenario) -> Step:
    """The scenario with tf2's answer in every step."""
    core = tf2_py.BufferCore(rospy.Duration.from_sec(scenario.keep))
    recorded: list[Step] = []
    for step in scenario.steps:
        verb = verb_of(step)
        stated = {key: value for key, value in step.items() if key != verb}
        recorded.append({verb: step[verb], "tf2": _ask(core, verb, step[verb]), **stated})
    return {"scenario": scenario.name, "keep": scenario.keep, "steps": recorded}


def _ask(core: Any, verb: str, arguments: list[Any]) -> Any:
    if verb == "insert":
        return _insert(core.set_transform, arguments)
    if verb == "insert static":
        return _insert(core.set_transform_static, arguments)
    if verb == "bag":
        return _insert_bag(core, *arguments)
    try:
        with _Log():
            return _QUESTIONS[verb](core, *arguments)
    except tf2_py.TransformException as error:
        return _name(error)


# Insertion


def _insert(set_transform: Any, arguments: list[Any], authority: str = "golden") -> str:
    parent, child, stamp, translation, rotation = arguments
    message = TransformStamped()
    message.header.frame_id = parent
    message.header.stamp = rospy.Time(*divmod(stamp, SECOND))
    message.child_frame_id = child
    place, turn = message.transform.translation, message.transform.rotation
    place.x, place.y, place.z = translation
    turn.x, turn.y, turn.z, turn.w = rotation
    with _Log() as log:
        set_transform(message, authority)
    refused = re.search(r"TF_\w+", log.text)
    return refused.group() if refused else "stored"


class _Log:
    """The text that is written to stderr inside a `with`; tf2 writes there from C++."""

    def __enter__(self) -> "_Log":
        self._file = _LOG_FILE
        self._file.seek(0)
        self._file.truncate()
        self._stderr = os.dup(2)
        os.dup2(self._file.fileno(), 2)
        return self

    def __exit__(self, *_: object) -> None:
        os.dup2(self._stderr, 2)
        os.close(self._stderr)
        self._file.seek(0)
        self.text = self._file.read()


_LOG_FILE = tempfile.TemporaryFile("w+")  # noqa: SIM115 - it lasts as long as the process


def _insert_bag(core: Any, name: str, shift: int) -> dict[str, int]:
    outcomes: Counter[str] = Counter()
    for is_static, parent, child, stamp, translation, rotation in transforms_in(name):
        insert = core.set_transform_static if is_static else core.set_transform
        outcomes[_insert(insert, [parent, child, stamp - shift * SECOND, translation, rotation])] += 1
    return dict(outcomes)


# Questions


def _time(at: Stamp) -> Any:
    return rospy.Time() if at == LATEST else rospy.Time(*divmod(int(at), SECOND))


def _lookup(core: Any, target: str, source: str, at: Stamp, *travel: Any) -> list[Any]:
    if travel:
        source_at, fixed = travel
        found = core.lookup_transform_full_core(target, _time(at), source, _time(source_at), fixed)
    else:
        found = core.lookup_transform_core(target, source, _time(at))
    place, turn = found.transform.translation, found.transform.rotation
    if (found.header.frame_id, found.child_frame_id) != (target, source):
        raise ValueError(f"asked for {target}, {source}, got {found}")
    return [
        found.header.stamp.to_nsec(),
        [_rounded(number) for number in (place.x, place.y, place.z)],
        [_rounded(number) for number in (turn.x, turn.y, turn.z, turn.w)],
    ]


def _rounded(number: float) -> float:
    return round(number, DIGITS)


def _can(core: Any, target: str, source: str, at: Stamp, *travel: Any) -> bool:
    if travel:
        source_at, fixed = travel
        return bool(core.can_transform_full_core(target, _time(at), source, _time(source_at), fixed)[0])
    return bool(core.can_transform_core(target, source, _time(at))[0])


def _latest(core: Any, target: str, source: str) -> int:
    stamp: int = core.get_latest_common_time(target, source).to_nsec()
    return stamp


def _chain(core: Any, target: str, source: str, at: Stamp) -> list[str]:
    # From source to target; the target as the fixed frame avoids a detour.
    return list(reversed(core._chain(target, _time(at), source, _time(at), target)))


def _parent(core: Any, frame: str) -> str | None:
    entry = re.search(rf"^{re.escape(frame)}: *\n  parent: '(.*)'$", core.all_frames_as_yaml(), re.MULTILINE)
    return entry.group(1) if entry else None


def _known(core: Any, frame: str) -> bool:
    return bool(core._frameExists(frame))


def _frames(core: Any) -> list[str]:
    return sorted(core._getFrameStrings())


def _clear(core: Any) -> None:
    core.clear()


_QUESTIONS: dict[str, Any] = {
    "lookup": _lookup,
    "can": _can,
    "latest": _latest,
    "chain": _chain,
    "parent": _parent,
    "known": _known,
    "frames": _frames,
    "clear": _clear,
}


def _name(error: Exception) -> str:
    name, message = type(error).__name__, str(error)
    if "contains a loop" in message:
        return f"{name}: loop"
    if name == "TransformException" and "not part of the same tree" in message:
        # The latest common time has no classes of its own for this.
        return f"{name}: disconnected"
    if name != "ExtrapolationException":
        return name
    if one := re.search(r"at time ([\d.]+), but only time ([\d.]+)", message):
        asked, only = map(float, one.groups())
        return f"{name}: one sample, asked for the {'future' if asked > only else 'past'}"
    for side in ("future", "past"):
        if f"into the {side}" in message:
            return f"{name}: {side}"
    return f"{name}: no samples"

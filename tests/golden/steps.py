"""The steps of a scenario: samples and questions, in order, each a small dict in a recording, a line of JSON.

A step's first key says what is done, its value holds the arguments::

    {"insert": [parent, child, stamp, translation, rotation]}           a moving sample
    {"insert static": [parent, child, stamp, translation, rotation]}    a static one
    {"bag": [name, shift]}                                              all of a bag, some whole seconds earlier
    {"clear": []}                                                       drop the moving samples
    {"lookup": [target, source, at]}                                    the pose of source, seen from target
    {"lookup": [target, source, at, source_at, fixed]}                  the same through a fixed frame
    {"can": ...}                                                        whether such a lookup has an answer
    {"latest": [target, source]}                                        the newest stamp that all edges have reached

The recorder adds ``"tf2"``, the real answer.
Where tfbus differs on purpose the step names the deviation, and says what tfbus answers instead, on whose word and why:
``ros2`` if ROS 1 and ROS 2 differ and tfbus does as ROS 2, ``design`` if it follows neither.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent / "recordings"

LATEST = "LATEST"
SECOND = 1_000_000_000

Step = dict[str, Any]
Stamp = int | str

TRANSLATION = {
    "LookupException": "UnknownFrameError",
    "ConnectivityException": "DisconnectedError",
    "TransformException: disconnected": "DisconnectedError",
    "ExtrapolationException: future": "FutureExtrapolationError",
    "ExtrapolationException: past": "PastExtrapolationError",
    "ExtrapolationException: one sample, asked for the future": "FutureExtrapolationError",
    "ExtrapolationException: one sample, asked for the past": "PastExtrapolationError",
    "ExtrapolationException: no samples": "FutureExtrapolationError",
    "TF_OLD_DATA": "expired",
    "TF_SELF_TRANSFORM": "invalid",
    "TF_NO_CHILD_FRAME_ID": "invalid",
    "TF_NO_FRAME_ID": "invalid",
    "TF_NAN_INPUT": "invalid",
    "TF_DENORMALIZED_QUATERNION": "invalid",
}
"""The names in tfbus of tf2's answers; those without a counterpart have none."""


@dataclass(frozen=True)
class Scenario:
    """Steps on one fresh tree that keeps some seconds of history."""

    name: str
    steps: list[Step]
    keep: float = 10.0


def verb_of(step: Step) -> str:
    """The kind of a step."""
    return next(iter(step))


# The files of recordings


def scenarios_in(path: Path) -> list[Scenario]:
    """The scenarios of a recording, without the answers: to be asked again."""
    return [
        Scenario(
            scenario["scenario"],
            [{key: value for key, value in step.items() if key != "tf2"} for step in scenario["steps"]],
            scenario["keep"],
        )
        for scenario in read(path)
    ]


def read(path: Path) -> list[Step]:
    """The recorded scenarios of one theme."""
    scenarios: list[Step] = json.loads(path.read_text(encoding="utf-8"))
    return scenarios


def as_text(scenarios: list[Step]) -> str:
    """The content of the file of one theme."""
    return "[\n" + ",\n".join(map(_scenario, scenarios)) + "\n]\n"


def _scenario(scenario: Step) -> str:
    steps = ",\n".join(
        json.dumps(_short(step), ensure_ascii=False, separators=(",", ":")) for step in scenario["steps"]
    )
    head = f'"scenario": {json.dumps(scenario["scenario"], ensure_ascii=False)}, "keep": {scenario["keep"]}'
    return f'{{{head}, "steps": [\n{steps}\n]}}'


def _short(value: Any) -> Any:
    """The same with 1 for 1.0."""
    if isinstance(value, dict):
        return {key: _short(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_short(part) for part in value]
    return int(value) if isinstance(value, float) and value.is_integer() and abs(value) < 1e15 else value

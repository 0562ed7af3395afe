"""Reads and writes the recordings: JSON, one step a line."""

import json
from pathlib import Path
from typing import Any

from steps import Step

FOLDER = Path(__file__).resolve().parent / "recordings"


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

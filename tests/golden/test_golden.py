"""tfbus answers what the real tf2 answered, or what is stated beside that: see README.md."""

import re
from pathlib import Path

import bags
import pytest
from steps import FOLDER, read
from tfbus_replay import disagreements

PATHS = sorted(FOLDER.glob("*.json"))
BAG_THEMES = {"pr2_tf", "turtlesim"}
THEMES = {path.stem: read(path) for path in PATHS}


@pytest.mark.parametrize("theme", THEMES)
def test_tfbus_answers_what_tf2_did_or_deviates_as_stated(theme: str) -> None:
    """Every recorded scenario; one on a bag only where the bag is."""
    bag = f"{theme}.bag"
    if theme in BAG_THEMES and not bags.is_there(bag):
        pytest.skip(f"no {bag}: set RECORDINGS to a folder that has it")
    found = {scenario["scenario"]: list(disagreements(scenario)) for scenario in THEMES[theme]}
    assert {name: differences for name, differences in found.items() if differences} == {}


def test_every_deviation_is_in_the_table_and_has_cases_and_nothing_else_is() -> None:
    table = (Path(__file__).parent / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+?) \| (ros2|design) \|.*\| ([^|]+?) \| ([^|]+?) \|$", table, re.MULTILINE)
    listed = {name: (expected_by, reason, cases) for name, expected_by, reason, cases in rows}
    assert len(listed) == len(rows)
    stated: dict[str, tuple[str, str, set[str]]] = {}
    for theme, scenarios in THEMES.items():
        for step in (step for scenario in scenarios for step in scenario["steps"] if "deviation" in step):
            facts = step["expected_by"], step["reason"]
            assert stated.setdefault(step["deviation"], (*facts, set()))[:2] == facts
            stated[step["deviation"]][2].add(theme)
    assert listed == {name: (by, reason, ", ".join(sorted(themes))) for name, (by, reason, themes) in stated.items()}


def test_the_recordings_hold_thousands_of_questions_to_at_least_a_hundred_random_trees() -> None:
    by_hand = {"changes", "latest", "names", "shapes", "values", "windows"}
    assert set(THEMES) == by_hand | BAG_THEMES | {"random"}
    questions = [step for scenario in THEMES["random"] for step in scenario["steps"] if step.keys() & {"lookup", "can"}]
    assert len(THEMES["random"]) >= 100
    assert len(questions) >= 3_000

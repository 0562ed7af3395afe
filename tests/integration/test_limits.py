"""The guide's page of bounds says what the code has."""

import importlib
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "demos" / "guide" / "limits.md"
UNITS = {"": 1, "levels": 1, "bytes": 1, "KiB": 2**10, "MiB": 2**20, "s": 1}
ROWS = re.findall(r"^\| (?!what \|)(.+?) \| ([\d,.e]+) ?(\w*) \|", PAGE.read_text(), re.MULTILINE)
BOUNDS = [
    (module, name)
    for module, names in (
        ("geometry.stamped", "MAX_TRANSLATION"),
        ("rows", "NORM_TOLERANCE"),
        ("bus.subscribers", "_QUEUED_BATCHES _KEPT LINES"),
        ("bus.event_stream", "_REFUSED_FRAMES _CLAIMS"),
        ("buffer.lookups", "REPORT_AFTER NAMED"),
        ("buffer.buffer", "_DESCRIBED"),
        ("errors", "MOST_NAMES LONGEST_NAME LOOKED_AT SHOWN_FRAMES"),
        ("tree.cycles", "_SENDERS"),
        ("analysis.arrivals", "MAX_SAMPLES"),
        ("cli.commands.query", "MAX_ROWS"),
        ("tf_message", "MAX_NAME"),
        ("links.message", "MAX_BYTES MAX_SAMPLES MAX_HEAD MAX_ENTRIES MAX_TEXT LONGEST_WAY"),
        ("links.link", "_MAX_BYTES MANY"),
        ("links.endpoint", "MAX_PEERS MAX_AUTHORITIES MOST_AUTHORITY_TEXT"),
        ("links.domain", "MOST_WAITING"),
        ("links.relay", "MOST_ORIGINS"),
        ("links.replica", "MANY_ORIGINS MOST_REMOVALS MOST_REMEMBERED CHUNK PATIENCE"),
        ("links.domain", "MOST_QUESTIONS SOONEST_SIGN MOST_ROBOTS"),
        ("links.channels", "MOST_FILTERS LONGEST_FILTER"),
        ("links.history", "LONGEST_HISTORY MOST_OF_FRAME MOST_HELD MOST_HELD_SAMPLES PATIENCE"),
        ("links.local.local_wire", "MOST_CONNECTIONS MOST_STRANGERS PATIENCE"),
        ("links.local.connection", "LONGEST_HELLO MOST_PUBLISHED MOST_SENT"),
        ("links.local.local_wire", "MOST_UNFINISHED"),
        ("links.local.meeting_place", "LONGEST_PATH"),
        ("links.zenoh.sessions", "UNSENT"),
        ("links.zenoh.wire", "MAX_LINKS MAX_CHANNELS"),
        ("links.zenoh.sessions", "OPENING_TIME"),
        ("links.domain", "_LONGEST_NAME"),
        ("links.message", "MAX_DEPTH"),
        ("links.lookups", "LONGEST_WAIT PATIENCE"),
        ("links.ros.ros_link", "MAX_SIZE MAX_OTHER_SIZE AT_ONCE PART MOST_TRANSFORMS"),
        ("links.rosbridge.rosbridge_link", "MOST_QUEUED SILENCE MOST_SAID"),
        ("links.rosbridge.protocol", "MAX_VALUE MAX_TEXT MOST_TRANSFORMS QUEUE"),
        ("links.dds.dds_link", "_DEPTH _KEPT"),
        ("links.dds.readers", "MOST_WAITING MOST_BYTES"),
        ("links.ros.settings", "_LAST_DOMAIN"),
        ("_aio.web_door", "MAX_HEAD HEAD_TIME"),
        ("links.foxglove", "MAX_CONNECTIONS"),
        ("view.server", "MAX_CONNECTIONS CAPACITY"),
        ("view.page", "EVENTS_KEPT _MATCHES SAMPLES"),
        ("view.server", "_PORTS_TRIED MAX_MESSAGE MAX_TEXT"),
        ("view.meshes", "MAX_BYTES MAX_NUMBERS MAX_VERTICES MAX_SHAPES"),
        ("plot.plots", "SAMPLES LONGEST_NAME"),
    )
    for name in names.split()
]
"""The constants of the rows of the page, in their order."""


def test_every_row_of_the_page_has_a_constant() -> None:
    assert len(ROWS) == len(BOUNDS)


@pytest.mark.parametrize(("row", "bound"), list(zip(ROWS, BOUNDS, strict=False)))
def test_the_page_says_what_the_code_has(row: tuple[str, str, str], bound: tuple[str, str]) -> None:
    what, number, unit = row
    module, name = bound
    code = importlib.import_module(f"tfbus.{module}")
    assert getattr(code, name) == float(number.replace(",", "")) * UNITS[unit], what

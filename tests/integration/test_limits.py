"""The guide's page of bounds says what the code has."""

import importlib
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "demos" / "guide" / "limits.md"
UNITS = {"": 1, "levels": 1, "bytes": 1, "KiB": 2**10, "MiB": 2**20, "s": 1}
ROWS = re.findall(r"^\| (?!what \|)(.+?) \| ([\d,.e]+) ?(\w*) \|", PAGE.read_text(), re.MULTILINE)
BOUNDS = {
    "geometry.bounds": "MAX_TRANSLATION",
    "geometry.rows": "NORM_TOLERANCE",
    "bus._subscribers": "_QUEUED_BATCHES",
    "bus.once_logger": "_KEPT",
    "bus._event_queue": "_REFUSED_FRAMES _CLAIMS",
    "buffer._hanging_report": "REPORT_AFTER NAMED",
    "buffer.buffer": "_DESCRIBED",
    "errors": "MOST_NAMES LONGEST_NAME LOOKED_AT SHOWN_FRAMES",
    "tree.cycles": "_SENDERS",
    "analysis.arrivals": "MAX_SAMPLES",
    "cli.commands.query": "MAX_ROWS",
    "tf_message": "MAX_NAME",
    "links._message": "MAX_BYTES",
    "links._attachment": "MAX_BYTES MAX_ENTRIES",
    "links.zenoh._settings": "UNSENT",
    "links._receive_queue": "MAX_BYTES MANY",
    "links._peers": "MAX_PEERS MAX_AUTHORITIES",
    "links._state": "MOST_GONE",
    "links._history": "LONGEST_HISTORY MOST_OF_FRAME MOST_HELD",
    "links.zenoh._dialing": "MOST_PEERS MOST_ADDRESSES",
    "links.zenoh._unmet": "MOST_UNMET",
    "links.zenoh._introductions": "MOST_NAMED MOST_MISSING",
    "links.zenoh._filters": "MOST_FILTERS LONGEST_FILTER",
    "links._asker": "MOST_OPEN",
    "links.zenoh._session": "MOST_QUESTIONS",
    "links.zenoh._keys": "LONGEST_NAME",
    "links._remote_lookup": "MAX_BYTES MAX_DEPTH",
    "links.zenoh.buffer_server": "LONGEST_WAIT",
    "links.ros._carrier": "MAX_SIZE MAX_OTHER_SIZE AT_ONCE PART MOST_TRANSFORMS",
    "links.rosbridge._carrier": "MOST_QUEUED SILENCE MOST_SAID",
    "links.rosbridge._protocol": "MAX_VALUE MOST_TRANSFORMS QUEUE",
    "links.dds._carrier": "_DEPTH _KEPT",
    "links.dds._publishers": "MOST_WAITING MOST_BYTES",
    "links.ros.settings": "_LAST_DOMAIN",
    "_aio.web_door": "MAX_HEAD HEAD_TIME",
    "links.foxglove": "MAX_CONNECTIONS",
    "view._controls": "CAPACITY",
    "view._page": "EVENTS_KEPT _MATCHES",
    "view._trails": "SAMPLES",
    "view._server": "_PORTS_TRIED MAX_MESSAGE MAX_TEXT",
    "view._meshes": "MAX_BYTES MAX_NUMBERS MAX_VERTICES MAX_SHAPES",
    "plot.series": "SAMPLES",
    "plot._style": "LONGEST_NAME",
}
"""The constants of the rows of the page, in their order."""


def test_every_row_of_the_page_has_a_constant() -> None:
    assert len(ROWS) == sum(len(names.split()) for names in BOUNDS.values())


@pytest.mark.parametrize("module", BOUNDS)
def test_the_page_says_what_the_code_has(module: str) -> None:
    modules = list(BOUNDS)
    first = sum(len(BOUNDS[before].split()) for before in modules[: modules.index(module)])
    names = BOUNDS[module].split()
    code = importlib.import_module(f"tfbus.{module}")
    for name, (what, number, unit) in zip(names, ROWS[first : first + len(names)], strict=True):
        assert getattr(code, name) == float(number.replace(",", "")) * UNITS[unit], what

"""The guide's page of bounds says what the code has."""

import importlib
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "demos" / "guide" / "limits.md"
UNITS = {"": 1, "levels": 1, "bytes": 1, "KiB": 2**10, "MiB": 2**20, "s": 1}
ROWS = re.findall(r"^\| (?!what \|)(.+?) \| ([\d,.e]+) ?(\w*) \|", PAGE.read_text(), re.MULTILINE)
BOUNDS = [
    "geometry.stamped.MAX_TRANSLATION",
    "rows.NORM_TOLERANCE",
    "bus.subscribers._QUEUED_BATCHES",
    "bus.subscribers._KEPT",
    "bus.subscribers.LINES",
    "bus.event_stream._REFUSED_FRAMES",
    "bus.event_stream._CLAIMS",
    "buffer.lookups.REPORT_AFTER",
    "buffer.lookups.NAMED",
    "buffer.buffer._DESCRIBED",
    "errors.MOST_NAMES",
    "errors.LONGEST_NAME",
    "errors.LOOKED_AT",
    "errors.SHOWN_FRAMES",
    "tree.cycles._SENDERS",
    "analysis.arrivals.MAX_SAMPLES",
    "cli.commands.query.MAX_ROWS",
    "tf_message.MAX_NAME",
    "links._message.MAX_BYTES",
    "links._message.MAX_SAMPLES",
    "links._attachment.MAX_BYTES",
    "links._attachment.MAX_ENTRIES",
    "links.zenoh._settings.UNSENT",
    "links._receive_queue.MAX_BYTES",
    "links._receive_queue.MANY",
    "links._peers.MAX_PEERS",
    "links._peers.MAX_AUTHORITIES",
    "links._state.MOST_GONE",
    "links._history.LONGEST_HISTORY",
    "links._history.MOST_OF_FRAME",
    "links._history.MOST_HELD",
    "links.zenoh._dialing.MOST_PEERS",
    "links.zenoh._dialing.MOST_ADDRESSES",
    "links.zenoh._unmet.MOST_UNMET",
    "links.zenoh._introductions.MOST_NAMED",
    "links.zenoh._introductions.MOST_MISSING",
    "links.zenoh._filters.MOST_FILTERS",
    "links.zenoh._filters.LONGEST_FILTER",
    "links.zenoh._filters.MOST_TOKENS",
    "links.zenoh._present.MOST_WAYS",
    "links.zenoh._notes.MOST_NOTED",
    "links._asker.MOST_OPEN",
    "links.zenoh._session.MOST_QUESTIONS",
    "links.zenoh._keys.LONGEST_NAME",
    "links._remote_lookup.MAX_BYTES",
    "links._remote_lookup.MAX_DEPTH",
    "links.zenoh.buffer_server.LONGEST_WAIT",
    "links.ros.ros_link.MAX_SIZE",
    "links.ros.ros_link.MAX_OTHER_SIZE",
    "links.ros.ros_link.AT_ONCE",
    "links.ros.ros_link.PART",
    "links.ros.ros_link.MOST_TRANSFORMS",
    "links.rosbridge.rosbridge_link.MOST_QUEUED",
    "links.rosbridge.rosbridge_link.SILENCE",
    "links.rosbridge.rosbridge_link.MOST_SAID",
    "links.rosbridge.protocol.MAX_VALUE",
    "links.rosbridge.protocol.MAX_TEXT",
    "links.rosbridge.protocol.MOST_TRANSFORMS",
    "links.rosbridge.protocol.QUEUE",
    "links.dds.dds_link._DEPTH",
    "links.dds.dds_link._KEPT",
    "links.dds.readers.MOST_WAITING",
    "links.dds.readers.MOST_BYTES",
    "links.ros.settings._LAST_DOMAIN",
    "_aio.web_door.MAX_HEAD",
    "_aio.web_door.HEAD_TIME",
    "links.foxglove.MAX_CONNECTIONS",
    "view.server.MAX_CONNECTIONS",
    "view.server.CAPACITY",
    "view.page.EVENTS_KEPT",
    "view.page._MATCHES",
    "view.page.SAMPLES",
    "view.server._PORTS_TRIED",
    "view.server.MAX_MESSAGE",
    "view.server.MAX_TEXT",
    "view.meshes.MAX_BYTES",
    "view.meshes.MAX_NUMBERS",
    "view.meshes.MAX_VERTICES",
    "view.meshes.MAX_SHAPES",
    "plot.plots.SAMPLES",
    "plot.plots.LONGEST_NAME",
]
"""The constants of the rows of the page, in their order."""


def test_every_row_of_the_page_has_a_constant() -> None:
    assert len(ROWS) == len(BOUNDS)


@pytest.mark.parametrize(("row", "bound"), list(zip(ROWS, BOUNDS, strict=False)))
def test_the_page_says_what_the_code_has(row: tuple[str, str, str], bound: str) -> None:
    what, number, unit = row
    module, _, name = bound.rpartition(".")
    code = importlib.import_module(f"tfbus.{module}")
    assert getattr(code, name) == float(number.replace(",", "")) * UNITS[unit], what

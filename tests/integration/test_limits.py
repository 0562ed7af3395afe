"""The guide's page of bounds says what the code has."""

import re
from importlib import import_module
from pathlib import Path

PAGE = Path(__file__).parents[2] / "demos" / "guide" / "limits.md"
UNITS = {"": 1, "levels": 1, "bytes": 1, "KiB": 2**10, "MiB": 2**20, "s": 1}
ROWS = re.findall(r"^\| (?!what \|)(.+?) \| ([\d,.e]+) ?(\w*) \|", PAGE.read_text(), re.MULTILINE)
NAMES = """
geometry.stamped.MAX_TRANSLATION rows.NORM_TOLERANCE bus.subscribers._QUEUED_BATCHES bus.subscribers._KEPT
bus.subscribers.LINES bus.event_stream._REFUSED_FRAMES bus.event_stream._CLAIMS buffer.lookups.REPORT_AFTER
buffer.lookups.NAMED buffer.buffer._DESCRIBED errors.MOST_NAMES errors.LONGEST_NAME errors.LOOKED_AT
errors.SHOWN_FRAMES tree.cycles._SENDERS analysis.arrivals.MAX_SAMPLES cli.commands.query.MAX_ROWS tf_message.MAX_NAME
links.message.MAX_BYTES links.message.MAX_SAMPLES links.message.MAX_HEAD links.message.MAX_ENTRIES
links.message.MAX_TEXT links.message.LONGEST_WAY links.link._MAX_BYTES links.link.MANY links.endpoint.MAX_PEERS
links.endpoint.MAX_AUTHORITIES links.endpoint.MOST_AUTHORITY_TEXT links.domain.MOST_WAITING links.relay.MOST_ORIGINS
links.replica.MANY_ORIGINS links.replica.MOST_REMOVALS links.clocks.MOST_ECHOES links.clocks.KEPT
links.clocks._MOST_ORIGINS links.replica.MOST_REMEMBERED links.replica.CHUNK
links.replica.PATIENCE links.domain.MOST_QUESTIONS links.domain.SOONEST_SIGN links.domain.MOST_ROBOTS
links.channels.MOST_FILTERS links.channels.LONGEST_FILTER links.history.LONGEST_HISTORY links.history.MOST_OF_FRAME
links.history.MOST_HELD links.history.MOST_HELD_SAMPLES links.history.PATIENCE links.history.LONGEST_ASKING
links.local.local_wire.MOST_CONNECTIONS
links.local.local_wire.MOST_STRANGERS links.local.local_wire.PATIENCE links.local.connection.LONGEST_HELLO
links.local.local_wire.MOST_HEARINGS
links.local.connection.MOST_PUBLISHED links.local.connection.MOST_SENT links.local.local_wire.MOST_UNFINISHED
links.local.meeting_place.LONGEST_PATH links.zenoh.sessions.UNSENT links.zenoh.wire.MAX_LINKS
links.zenoh.wire.MAX_CHANNELS links.zenoh.sessions.OPENING_TIME links.domain._LONGEST_NAME links.message.MAX_DEPTH
links.lookups.LONGEST_WAIT links.lookups.PATIENCE links.ros.ros_link.MAX_SIZE links.ros.ros_link.MAX_OTHER_SIZE
links.ros.ros_link.AT_ONCE links.ros.ros_link.PART links.ros.ros_link.MOST_TRANSFORMS
links.rosbridge.rosbridge_link.MOST_QUEUED links.rosbridge.rosbridge_link.SILENCE
links.rosbridge.rosbridge_link.MOST_SAID links.rosbridge.protocol.MAX_VALUE links.rosbridge.protocol.MAX_TEXT
links.rosbridge.protocol.MOST_TRANSFORMS links.rosbridge.protocol.QUEUE links.dds.dds_link._DEPTH
links.dds.dds_link._KEPT links.dds.readers.MOST_WAITING links.dds.readers.MOST_BYTES links.ros.settings._LAST_DOMAIN
_aio.web_door.MAX_HEAD _aio.web_door.HEAD_TIME _aio.web_server.MAX_CONNECTIONS
links.rosbridge.rosbridge_server.MAX_REQUEST links.rosbridge.rosbridge_server.MOST_FRAMES
links.rosbridge.rosbridge_server.MOST_REQUESTS links.rosbridge.rosbridge_server.MOST_WAITING
links.rosbridge.rosbridge_server.MOST_CONFLATED links.rosbridge.rosbridge_server.MOST_AT_ONCE
links.rosbridge.rosbridge_server.LONGEST_ERROR view.view._ORDERS
view.session.EVENTS_KEPT view.session.SAMPLES view.session.MAX_TRAILS recording.points.MAX_POINTS
recording.recording.MAX_PENDING
view.session.MAX_MESSAGE view.meshes.MAX_BYTES view.meshes.MAX_NUMBERS view.meshes.MAX_VERTICES view.meshes.MAX_SHAPES
plot.plots.SAMPLES plot.plots.LONGEST_NAME
"""
"""The constants of the rows of the page, in their order."""


def value(path: str) -> float:
    module, _, name = path.rpartition(".")
    number: float = getattr(import_module(f"tfbus.{module}"), name)
    return number


def test_the_page_says_what_the_code_has() -> None:
    said = {what: float(number.replace(",", "")) * UNITS[unit] for what, number, unit in ROWS}
    assert said == {what: value(name) for what, name in zip(said, NAMES.split(), strict=True)}

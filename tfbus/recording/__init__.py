"""Recordings of transforms in files.

A `Recorder` writes everything that a bus publishes to an MCAP file, and a `Player` publishes a recording on a bus.
`load` reads a whole recording into a `tfbus.TransformTree`, `summarise` lists its frames and problems, and
`open_recording` gives its messages one after the other. `load_points` reads the clouds and scans of a topic, and
`load_static` a file with static transforms. `save_trajectory` writes poses for the tools of benchmarks. The file
formats are in `tfbus.recording.formats`.
"""

from tfbus.errors import RecordingError
from tfbus.recording.convert import Conversion, Edits, StaticTransform, convert, save_trajectory
from tfbus.recording.examine import examine
from tfbus.recording.header_stamps import HeaderStamps, header_stamps
from tfbus.recording.joint_states import load_joint_states
from tfbus.recording.player import Player
from tfbus.recording.points import load_points
from tfbus.recording.recorder import Recorder
from tfbus.recording.recording import RecordedMessage, RecordedTopic, Recording, load, open_recording
from tfbus.recording.static_frames import load_static, save_static
from tfbus.recording.summary import FrameSummary, RecordingSummary, SenderSummary, Spread, summarise

__all__ = [
    "Conversion",
    "Edits",
    "FrameSummary",
    "HeaderStamps",
    "Player",
    "RecordedMessage",
    "RecordedTopic",
    "Recorder",
    "Recording",
    "RecordingError",
    "RecordingSummary",
    "SenderSummary",
    "Spread",
    "StaticTransform",
    "convert",
    "examine",
    "header_stamps",
    "load",
    "load_joint_states",
    "load_points",
    "load_static",
    "open_recording",
    "save_static",
    "save_trajectory",
    "summarise",
]

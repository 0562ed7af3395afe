"""Recordings: written by a `Recorder`, read offline, and played into a bus."""

from tfbus.errors import RecordingError
from tfbus.recording.load import load
from tfbus.recording.player import Player
from tfbus.recording.recorder import Recorder
from tfbus.recording.recording import RecordedMessage, Recording, open_recording
from tfbus.recording.summary import FrameSummary, RecordingSummary, summarise

__all__ = [
    "FrameSummary",
    "Player",
    "RecordedMessage",
    "Recorder",
    "Recording",
    "RecordingError",
    "RecordingSummary",
    "load",
    "open_recording",
    "summarise",
]

"""The bus: a published sample reaches every buffer, stream and subscriber of the process."""

from tfbus.bus.broadcaster import TransformBroadcaster
from tfbus.bus.bus import Bus, ThreadPublisher
from tfbus.bus.event_stream import EventStream
from tfbus.bus.queues import Stream

__all__ = ["Bus", "EventStream", "Stream", "ThreadPublisher", "TransformBroadcaster"]

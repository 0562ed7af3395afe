"""The bus: what is published reaches every buffer, stream and subscriber of the process."""

from tfbus.bus.broadcaster import TransformBroadcaster
from tfbus.bus.bus import Bus
from tfbus.bus.event_stream import EventStream
from tfbus.bus.stream import Stream
from tfbus.bus.thread_publisher import ThreadPublisher

__all__ = ["Bus", "EventStream", "Stream", "ThreadPublisher", "TransformBroadcaster"]

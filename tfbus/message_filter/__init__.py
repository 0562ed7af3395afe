"""Messages, each paired with the transform of its own stamp."""

from tfbus.message_filter.message_filter import MessageFilter

__all__ = ["MessageFilter"]

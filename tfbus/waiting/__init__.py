"""Who waits for which data: the lookups and watches that an insertion concerns, found without looking at the others.

No event loop: whoever waits brings along a function that wakes it.
"""

from tfbus.waiting.waiting_index import PendingLookup

__all__ = ["PendingLookup"]

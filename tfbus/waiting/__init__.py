"""Waiting lookups and open watches: an insertion finds the affected ones without a look at the others.

There is no event loop here: each waiter brings along the function that wakes it.
"""

from tfbus.waiting.live_tree import PendingLookup

__all__ = ["PendingLookup"]

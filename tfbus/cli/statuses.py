"""The exit statuses of the command."""

FAILED, USAGE_ERROR, INTERRUPTED, ENDED_BY_SIGNAL = 1, 2, 130, 128
"""The number of a signal is added to the last one."""

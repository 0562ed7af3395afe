"""The beginning of zenoh's sessions."""

import re

import zenoh

from tfbus.links.zenoh._settings import without_source_location


def open_session(config: zenoh.Config) -> zenoh.Session:
    """Open a session; blocks.

    Raises
    ------
    OSError
        If it cannot listen where it should, or as a client reaches nobody; with its `errno`, if there is one.
    """
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        text = f"zenoh cannot open a session: {without_source_location(error)}"
        number = re.search(r"\(os error (\d+)\)", text)
        raise (OSError(int(number[1]), text) if number else OSError(text)) from error

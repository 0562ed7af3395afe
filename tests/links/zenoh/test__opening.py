import errno
import socket

import pytest

from tfbus.links.zenoh._opening import directly, open_session
from tfbus.links.zenoh._settings import settings


def test_a_port_in_use_is_an_os_error_with_its_number() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        config = settings(f"tcp/127.0.0.1:{server.getsockname()[1]}", None, None, 2.0)
        with pytest.raises(OSError, match="zenoh cannot open a session") as caught:
            open_session(config)
    assert caught.value.errno == errno.EADDRINUSE
    assert ".rs:" not in str(caught.value)


def test_an_os_error_that_only_zenoh_has_found_has_no_number() -> None:
    config = settings("tls/127.0.0.1:0", None, None, 2.0)
    with pytest.raises(OSError, match="private key") as caught:
        open_session(config)
    assert caught.value.errno is None


def test_what_is_received_by_several_subscribers_stays_in_order() -> None:
    assert not directly(print, print).indirect, "each would have a thread of its own"


def test_what_a_callback_raises_is_told_to_one_that_counts() -> None:
    told: list[Exception] = []
    handler = directly({"known": 1}.__getitem__, told.append)
    handler.callback("known")
    handler.callback("unknown")
    assert list(map(type, told)) == [KeyError]

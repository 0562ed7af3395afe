"""Threads that read while the test writes."""

import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager


@contextmanager
def threads_that(read: Callable[[], None]) -> Iterator[None]:
    """Two threads call `read` over and over while the block runs, and take turns as often as they can."""
    begun, done = threading.Barrier(3), threading.Event()

    def go_on() -> None:
        begun.wait()
        while not done.is_set():
            read()

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(2) as pool:
            readers = [pool.submit(go_on) for _ in range(2)]
            begun.wait()
            try:
                yield
            finally:
                done.set()
        for reader in readers:
            reader.result()
    finally:
        sys.setswitchinterval(interval)

"""Threads that read while the test writes."""

import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager


@contextmanager
def threads_that(read: Callable[[], None], number: int = 2) -> Iterator[None]:
    """Some threads call `read` over and over while the block runs, and take turns as often as they can."""
    begun, done = threading.Barrier(number + 1), threading.Event()

    def go_on() -> None:
        begun.wait()
        while not done.is_set():
            read()

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(number) as pool:
            readers = [pool.submit(go_on) for _ in range(number)]
            begun.wait()
            try:
                yield
            finally:
                done.set()
        for reader in readers:
            reader.result()
    finally:
        sys.setswitchinterval(interval)

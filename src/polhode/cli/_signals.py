"""Ctrl-C and termination: raised where they arrive, and again where they were swallowed.

Python delivers a signal as an exception in whatever runs at that moment. Where that is a callback
of a library (JAX's after a garbage collection, for one), the exception is printed and forgotten.
So every signal is noted, and `heed` raises it again between the pieces of the work.
"""

import contextlib
import signal
import threading
import types
from collections.abc import Iterator

INTERRUPTED, TERMINATED = 130, 143
_seen: list[int] = []


@contextlib.contextmanager
def heeded() -> Iterator[None]:
    """Let both signals unwind like an exception, so that temporary files are removed."""
    _seen.clear()
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: types.FrameType | None) -> None:
        _seen.append(number)
        heed()

    watched = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not of a background job
        watched.append(signal.SIGINT)
    before = {number: signal.signal(number, stop) for number in watched}
    try:
        yield
        heed()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def heed() -> None:
    """Raise what a signal that came before should have raised."""
    if signal.SIGTERM in _seen:
        raise SystemExit(TERMINATED)
    if _seen:
        raise KeyboardInterrupt

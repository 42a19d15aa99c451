"""Ctrl-C and termination: raised where they arrive, and again where they were swallowed.

Python delivers a signal as an exception in whatever runs at that moment. Where that is a callback
of a library (JAX's after a garbage collection, for one), the exception is printed and forgotten.
So every signal is noted, and `heed` raises it again between the pieces of the work. And an
exception that meets a callback of C++ ends the process by an abort: while JAX is at work the
exception waits for a moment outside of it, and after some seconds the process ends at once, which
leaves nothing half-written, since no file is open meanwhile.
"""

import contextlib
import signal
import threading
import time
import types
from collections.abc import Callable, Iterator

INTERRUPTED, TERMINATED = 130, 143
_PATIENCE = 5.0
_seen: list[int] = []


@contextlib.contextmanager
def heeded(leave: Callable[[int], None]) -> Iterator[None]:
    """Let both signals unwind like an exception, so that temporary files are removed; ``leave``
    ends the process where that cannot be.
    """
    _seen.clear()
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    began = []

    def stop(number: int, frame: types.FrameType | None) -> None:
        if number in (signal.SIGINT, signal.SIGTERM):
            _seen.append(number)
            began.append(time.monotonic())
        if not hasattr(signal, "setitimer") or not _in_jax(frame):
            heed()
        elif time.monotonic() - began[0] > _PATIENCE:
            leave(TERMINATED if signal.SIGTERM in _seen else INTERRUPTED)
        else:
            signal.setitimer(signal.ITIMER_REAL, 0.1)

    watched = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not of a background job
        watched.append(signal.SIGINT)
    if hasattr(signal, "SIGALRM"):
        watched.append(signal.SIGALRM)
    before = {number: signal.signal(number, stop) for number in watched}
    try:
        yield
        heed()
    finally:
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _in_jax(frame: types.FrameType | None) -> bool:
    """Whether JAX or a library of it is among the callers."""
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] in ("jax", "jaxlib"):
            return True
        frame = frame.f_back
    return False


def heed() -> None:
    """Raise what a signal that came before should have raised."""
    if signal.SIGTERM in _seen:
        raise SystemExit(TERMINATED)
    if _seen:
        raise KeyboardInterrupt

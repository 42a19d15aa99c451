"""Process-wide settings of a command: signal handlers, the cache of compiled programs, progress.

A signal handler raises its exception in whatever code runs at that moment. If that is a callback of
a library (such as the one of JAX after a garbage collection), the exception is printed and
discarded. Signals are therefore recorded as well, and ``check_signals``, called between the stages
of a command, raises the exception again.
"""

import contextlib
import importlib.util
import os
import signal
import threading
import types
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

INTERRUPTED, TERMINATED = 130, 143
_received: list[int] = []
_MAX_BYTES = 2**30
_OFF = ("off", "0", "no", "false", "")


@contextlib.contextmanager
def signal_handlers() -> Iterator[None]:
    """SIGINT and SIGTERM raise exceptions in the block, so that temporary files are removed."""
    _received.clear()
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: types.FrameType | None) -> None:
        if number != alarm:
            _received.append(number)
        if alarm is not None and _is_importing(frame):
            previous.setdefault(alarm, signal.signal(alarm, stop))
            signal.setitimer(signal.ITIMER_REAL, _AGAIN)
        else:
            check_signals()

    alarm = getattr(signal, "SIGALRM", None)  # not on Windows
    watched = [signal.SIGTERM]
    # not in a background job of a shell, which ignores SIGINT
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        watched.append(signal.SIGINT)
    previous: dict[int | None, Any] = {n: signal.signal(n, stop) for n in watched}
    try:
        yield
        check_signals()
    except Exception:
        check_signals()  # a library may have converted the interrupt to another error
        raise
    finally:
        if alarm in previous:  # otherwise a timer may belong to the caller
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]


_AGAIN = 0.05
"""Time [s] after which a signal received during an import is handled again."""


def _is_importing(frame: types.FrameType | None) -> bool:
    """Whether a module is being imported. An exception during the initialisation of an extension
    module of jaxlib aborts the process, so that signals must wait."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def check_signals() -> None:
    """Raise the exception of a signal received earlier, in case a library has discarded it."""
    if signal.SIGTERM in _received:
        raise SystemExit(TERMINATED)
    if _received:
        raise KeyboardInterrupt


@contextlib.contextmanager
def program_cache(enabled: bool) -> Iterator[None]:
    """Use JAX's persistent compilation cache in the block, in the user's cache folder.

    Off if `enabled` is false or POLHODE_CACHE is "off"; that variable may also name the folder. A
    folder in JAX's own settings has precedence. Entries that cannot be read or written are ignored
    silently; after a damaged entry the cache is cleared.
    """
    import jax

    name = os.environ.get("POLHODE_CACHE")
    if not enabled or (name is not None and name.lower() in _OFF):
        yield
        return
    # JAX defines this attribute at run time; its type stubs lack it
    own_folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    folder = None if own_folder else _folder(name)
    settings = {}
    if folder is not None:
        settings = {
            "jax_compilation_cache_dir": str(folder),
            "jax_persistent_cache_min_compile_time_secs": 0.0,
            "jax_persistent_cache_min_entry_size_bytes": -1,
        }
        if importlib.util.find_spec("filelock") is not None:
            settings["jax_compilation_cache_max_size"] = _MAX_BYTES
    previous = {key: getattr(jax.config, key) for key in settings}
    show, damaged = warnings.showwarning, []

    def listen(message, *args, **kwargs):
        if "persistent compilation cache" in str(message):
            damaged.append(message)
        else:
            show(message, *args, **kwargs)

    _set(settings)
    warnings.showwarning = listen
    try:
        yield
    finally:
        warnings.showwarning = show
        _set(previous)
        if damaged and folder is not None:
            for file in folder.glob("*-cache"):
                file.unlink(missing_ok=True)


def _set(settings: dict[str, Any]) -> None:
    """Update settings of JAX; it reads those of the cache only once, so the cache is reset."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    for name, value in settings.items():
        jax.config.update(name, value)
    if settings:
        compilation_cache.reset_cache()


def _folder(name: str | None) -> Path | None:
    """The cache folder, created if needed, or None if it is not writable.

    Its name depends on the CPU features, because compiled programs use their instructions.
    """
    try:
        if name is None:
            import platformdirs

            base = platformdirs.user_cache_path("polhode")
        else:
            base = Path(name)
        folder = base / f"programs-{_processor()}"
        folder.mkdir(parents=True, exist_ok=True)
        return folder if os.access(folder, os.W_OK) else None
    except (ImportError, OSError, RuntimeError, ValueError):
        return None


def _processor() -> str:
    import hashlib
    import platform

    words = platform.machine()
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        words += next((line for line in file if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(words.encode()).hexdigest()[:12]


def progress_console(quiet: bool) -> Any:
    """The console for progress displays, quiet unless stderr is a terminal."""
    from rich.console import Console

    console = Console(stderr=True)
    console.quiet = quiet or not console.is_terminal
    return console


def progress_bar(console: Any, last: Any) -> Any:
    """A progress bar of the bodies, with ``last`` as its last column."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TextColumn("bodies")
    return Progress(*columns, last, console=console, transient=True)


@contextlib.contextmanager
def spinner(console: Any, words: str) -> Iterator[Callable[[str], None]]:
    """Show the current stage and the elapsed time; yields a function that changes the text."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn("{task.description} ..."), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(words, total=None)
        yield lambda words: progress.update(task, description=words)


def print_paths(console: Any, paths: Iterable[Path]) -> None:
    """Print the names of the files written."""
    from polhode.files._read import escape

    names = ", ".join(escape(str(path)) for path in paths)
    console.print(f"written: {names}", highlight=False, markup=False)

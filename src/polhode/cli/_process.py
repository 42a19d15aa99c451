"""What a command changes in its process while it runs: signals, the cache of programs, progress.

Python delivers a signal as an exception in whatever code runs at that moment. If that is a callback
of a library (such as the one of JAX after a garbage collection), the exception is printed and
dropped. Every signal is therefore recorded, and ``check_signals`` raises it again between pieces of
the work.
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
    """Let both signals unwind like an exception, so that temporary files are removed."""
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
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not of a background job
        watched.append(signal.SIGINT)
    previous: dict[int | None, Any] = {n: signal.signal(n, stop) for n in watched}
    try:
        yield
        check_signals()
    except Exception:
        check_signals()  # a library may have turned the interrupt into an error of its own
        raise
    finally:
        if alarm in previous:  # a timer of the caller stays as it is
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]


_AGAIN = 0.05
"""[s] After which a signal that came during an import is looked at again."""


def _is_importing(frame: types.FrameType | None) -> bool:
    """Whether a module is being imported: an extension module of jaxlib, left by an exception while
    it is initialised, aborts the process."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def check_signals() -> None:
    """Raise what a signal that came before should have raised."""
    if signal.SIGTERM in _received:
        raise SystemExit(TERMINATED)
    if _received:
        raise KeyboardInterrupt


@contextlib.contextmanager
def program_cache(enabled: bool) -> Iterator[None]:
    """Have JAX store the programs that it compiles in the block, in the user's cache folder.

    Off when `enabled` is false or POLHODE_CACHE is "off"; that variable may also name the folder. A
    folder that JAX was given by its own settings stays. What cannot be read or written is compiled
    again without a word, and a damaged entry is removed.
    """
    import jax

    name = os.environ.get("POLHODE_CACHE")
    if not enabled or (name is not None and name.lower() in _OFF):
        yield
        return
    # JAX adds its settings when it runs, which its types do not tell
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
    """JAX looks at its settings when it first compiles, so it has to look again."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    for name, value in settings.items():
        jax.config.update(name, value)
    if settings:
        compilation_cache.reset_cache()


def _folder(name: str | None) -> Path | None:
    """The folder of this kind of processor (programs hold its instructions), made; None: none."""
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
    """The console for progress, which is for people who watch: nothing goes into a log file."""
    from rich.console import Console

    console = Console(stderr=True)
    console.quiet = quiet or not console.is_terminal
    return console


def progress_bar(console: Any, last: Any) -> Any:
    """A bar of bodies done, with the column ``last`` at its end."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TextColumn("bodies")
    return Progress(*columns, last, console=console, transient=True)


@contextlib.contextmanager
def spinner(console: Any, words: str) -> Iterator[Callable[[str], None]]:
    """Show what is done and the time that it has taken; what is yielded changes the words."""
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

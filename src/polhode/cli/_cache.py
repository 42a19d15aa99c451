"""Compiled programs kept between runs, in the user's cache folder."""

import contextlib
import hashlib
import importlib.util
import os
import platform
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

VARIABLE = "POLHODE_CACHE"
_MOST_BYTES = 2**30
_OFF = ("off", "0", "no", "false", "")


@contextlib.contextmanager
def kept_programs(wanted: bool) -> Iterator[None]:
    """Have JAX keep the programs that it compiles in the block.

    Off when `wanted` is false or POLHODE_CACHE is "off"; that variable may also name the folder. A
    folder that JAX was given by its own settings stays. What cannot be read or written is compiled
    again without a word, and a damaged entry is removed.
    """
    import jax

    named = os.environ.get(VARIABLE)
    if not wanted or (named is not None and named.lower() in _OFF):
        yield
        return
    # JAX adds its settings when it runs, which its types do not tell
    given = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    folder = None if given else _folder(named)
    settings = {}
    if folder is not None:
        settings = {
            "jax_compilation_cache_dir": str(folder),
            "jax_persistent_cache_min_compile_time_secs": 0.0,
            "jax_persistent_cache_min_entry_size_bytes": -1,
        }
        if importlib.util.find_spec("filelock") is not None:
            settings["jax_compilation_cache_max_size"] = _MOST_BYTES
    before = {name: getattr(jax.config, name) for name in settings}
    show, damaged = warnings.showwarning, []

    def listen(message, *rest, **more):
        if "persistent compilation cache" in str(message):
            damaged.append(message)
        else:
            show(message, *rest, **more)

    _set(settings)
    warnings.showwarning = listen
    try:
        yield
    finally:
        warnings.showwarning = show
        _set(before)
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


def _folder(named: str | None) -> Path | None:
    """The folder of this kind of processor (programs hold its instructions), made; None: none."""
    try:
        if named is None:
            import platformdirs

            base = platformdirs.user_cache_path("polhode")
        else:
            base = Path(named)
        folder = base / f"programs-{_processor()}"
        folder.mkdir(parents=True, exist_ok=True)
        return folder if os.access(folder, os.W_OK) else None
    except (ImportError, OSError, RuntimeError, ValueError):
        return None


def _processor() -> str:
    words = platform.machine()
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        words += next((line for line in file if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(words.encode()).hexdigest()[:12]

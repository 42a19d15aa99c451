"""Atomic writing of files: a temporary file beside the target is synced and then renamed."""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic_write(target: str | os.PathLike) -> Iterator[Path]:
    """A temporary path in the folder of `target`; it replaces `target` if the block succeeds.

    If the block raises, KeyboardInterrupt included, the temporary file is removed and an existing
    `target` is not changed. The folder must exist. An OSError of the operating system is raised
    with a message that names the target and its folder.
    """
    target = Path(target).resolve()
    # the suffix is last, because functions that write figures choose the format by it
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(6)}.part{target.suffix}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        if error.errno is None or error.strerror is None:
            raise
        raise OSError(
            error.errno,
            f"{error.strerror}: cannot write {target.name} in the folder {target.parent}; nothing"
            " was changed there",
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
    if hasattr(os, "O_DIRECTORY"):  # Windows cannot open folders
        sync(target.parent)


def sync(path: Path) -> None:
    """Write a file, or the names in a folder, to the disk, so that they survive a power failure."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

"""Files written whole or not at all: beside the target, synced, then renamed."""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic_write(target: str | os.PathLike) -> Iterator[Path]:
    """A temporary path in the folder of `target` that replaces `target` when the block succeeds.

    When the block raises anything, KeyboardInterrupt included, the temporary file is removed and an
    existing `target` is left as it was. The folder must exist. An OSError of the system names the
    target and its folder.
    """
    target = Path(target).resolve()
    # the suffix stays last: writers of figures choose the format by it
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
    """Have a file, or the names in a folder, on the disk, also when the power goes."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

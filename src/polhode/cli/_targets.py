"""Files that a command is to write: what may be replaced, and what was."""

import os
import re
import stat
from pathlib import Path

from polhode.files._error import visible

_chosen: dict[Path, tuple[int, int] | None] = {}


class UsageError(Exception):
    """Options that do not fit each other or the file: exit code 2."""


def forget() -> None:
    """Begin anew: no file was chosen."""
    _chosen.clear()


def check_suffix(text: str, *suffixes: str, what: str) -> None:
    """UsageError for a name with the suffix of a format that the command does not write.

    What follows a dot and does not begin with a letter (``run_0.5``) is part of the name.
    """
    suffix = Path(text).suffix
    if re.fullmatch(r"\.[A-Za-z]\w*", suffix) and suffix not in suffixes:
        raise UsageError(
            f"cannot write {visible(text)}: {what} has the suffix {' or '.join(suffixes)}, not"
            f" {visible(suffix)}; name such a file, or leave the suffix out"
        )


def stem(text: str, *suffixes: str, what: str) -> str:
    """The name without one of the suffixes, of files that differ in them. Raises as above."""
    check_suffix(text, *suffixes, what=what)
    return text.removesuffix(Path(text).suffix) if Path(text).suffix in suffixes else text


def target(path: Path | str, suffix: str, *, force: bool, confined: bool = False) -> Path:
    """The file to write, its folder made; OSError before the work rather than after it.

    An existing file that polhode did not write, and a link, are replaced only by `force`.
    `confined`: a name from a scene file, which must not lead out of the current folder.
    """
    text = os.fspath(path)
    if "\0" in text:
        raise UsageError(f"the output {visible(text)} holds a NUL character: name a file")
    path = Path(text)
    if path.name in ("", "..") or path.is_dir():
        raise IsADirectoryError(
            f"{visible(text)} is a folder: name a file to write, such as"
            f" {visible(str(path / 'out'))}{suffix}"
        )
    if path.suffix != suffix:
        path = path.with_name(path.name + suffix)
    here = Path.cwd().resolve()
    if confined and not path.resolve().is_relative_to(here):
        raise UsageError(
            f"[output] file: {visible(text)} leads out of the folder {here} by a link; name a file"
            " below it, or any place by -o on the command line"
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(f"{path} is a folder: name a file to write")
        if os.path.lexists(path) and not force and not _ours(path):
            kind = "is a link" if path.is_symlink() else "was not written by polhode"
            raise FileExistsError(
                f"{visible(str(path))} exists and {kind}: name another file, or give --force to"
                " replace it"
            )
        probe = path.parent / f".{path.stem}.probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        if error.strerror is None:
            raise
        raise OSError(
            f"cannot write {visible(path.name)} in the folder {visible(str(path.parent))}:"
            f" {error.strerror}"
        ) from error
    _chosen[path] = _identity(path)
    return path


def changed() -> tuple[list[Path], list[Path]]:
    """The chosen files that are new or replaced, and those that are as they were."""
    new = [path for path, before in _chosen.items() if _identity(path) != before]
    return new, [path for path in _chosen if path not in new]


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


def _ours(path: Path) -> bool:
    """Whether a file is empty or names polhode as its maker."""
    found = path.lstat()
    if not stat.S_ISREG(found.st_mode):
        return False
    if found.st_size == 0:
        return True
    if path.suffix == ".nc":
        import h5py

        try:
            with h5py.File(path, "r") as file:
                maker = file.attrs.get("source", "")
        except OSError:
            return False
        maker = maker.decode(errors="replace") if isinstance(maker, bytes) else str(maker)
        return maker.startswith("polhode")
    with open(path, "rb") as file:
        return b"polhode" in file.read(65536)

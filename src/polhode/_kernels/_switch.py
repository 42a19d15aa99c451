"""Whether the compiler tricks of this room are used."""

import functools
import os
import subprocess
import sys
import warnings
from pathlib import Path

import jaxlib.version

TESTED = ((0, 7, 0), (0, 10, 2))
"""First and last version of jaxlib on which the marks were tested."""

_PROBE = ("-m", "polhode._kernels._probe")
_PATIENCE = 300
"""Seconds after which a child process that compiles a few small programs counts as stuck."""


def is_plain() -> bool:
    """Whether programs are left as they are written.

    ``POLHODE_PLAIN=1`` asks for it, ``POLHODE_PLAIN=0`` for the tricks whatever the version of
    jaxlib. Unset, versions outside of those tested are tried out once, in a child process.
    """
    asked = os.environ.get("POLHODE_PLAIN", "")
    return asked != "0" if asked else not _marks_work(jaxlib.version.__version__)


@functools.cache
def _marks_work(version: str) -> bool:
    first, last = TESTED
    return first <= _numbers(version) <= last or _kept_probe(version)


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".")[:3] if part.isdigit())


def _kept_probe(version: str) -> bool:
    """What trying the marks out has shown, now or before; a warning where they fail."""
    kept = _cache_folder() / f"marks-jaxlib-{version}"
    try:
        found = kept.read_text()
    except OSError:
        found = _probed()
        if found != "stuck":
            _keep(kept, found)
    if found != "work":
        warnings.warn(
            f"jaxlib {version} is outside of the versions {_written(TESTED[0])} to"
            f" {_written(TESTED[1])} that polhode was tested on, and a trial of its marked calls"
            f" ended badly ({found}): programs are compiled without them and run slower. Set"
            " POLHODE_PLAIN=1 to ask for this without a warning.",
            stacklevel=2,
        )
    return found == "work"


def _probed() -> str:
    environment = {**os.environ, "POLHODE_PLAIN": "0", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, *_PROBE]
    try:
        ran = subprocess.run(command, env=environment, capture_output=True, timeout=_PATIENCE)
    except subprocess.TimeoutExpired:
        return "stuck"
    except OSError:
        return "no child process"
    return "work" if ran.returncode == 0 else f"exit code {ran.returncode}"


def _keep(path: Path, found: str) -> None:
    """For later processes, where that is possible."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(found)
    except OSError:
        pass


def _cache_folder() -> Path:
    named = os.environ.get("XDG_CACHE_HOME")
    return (Path(named) if named else Path.home() / ".cache") / "polhode"


def _written(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))

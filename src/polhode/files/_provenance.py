"""Where a file comes from: versions of the libraries and the commit of polhode."""

import functools
import importlib.metadata
import json
import platform
import subprocess
from pathlib import Path

LIBRARIES = ("polhode", "jax", "jaxlib", "diffrax", "equinox", "numpy")


def versions() -> dict[str, str]:
    """NAME_version of polhode, Python and the libraries that compute; a note where fused kernels
    and the other optimisations for CPUs are off, since results differ by rounding."""
    import polhode
    from polhode._policy import plain_reason

    found = {"python_version": platform.python_version()}
    for name in LIBRARIES:
        own = name == "polhode"
        found[f"{name}_version"] = polhode.__version__ if own else importlib.metadata.version(name)
    reason = plain_reason()
    if reason is not None:
        found["cpu_optimisations"] = f"off: {reason}"
    return found


@functools.cache
def commit() -> str:
    """The commit that polhode was installed from or is run from; empty where that is not known.

    "+changes" follows that of a checkout with uncommitted changes.
    """
    folder = Path(__file__).resolve().parents[3]
    if (folder / ".git").exists():
        found = _git(folder, "rev-parse", "HEAD")
        changes = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", "src")
        return found + ("+changes" if found and changes else "")
    try:
        source = importlib.metadata.distribution("polhode").read_text("direct_url.json")
        return str(json.loads(source or "{}").get("vcs_info", {}).get("commit_id", ""))
    except (importlib.metadata.PackageNotFoundError, ValueError, AttributeError):
        return ""


def _git(folder: Path, *words: str) -> str:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *words], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""

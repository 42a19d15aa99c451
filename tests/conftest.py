"""Settings shared by every test: float64 available, strict promotion, the folder of truth files."""

import gc
import os
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:  # one core a worker: XLA reads this when it wakes up
    os.environ.setdefault("NPROC", "1")

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


def _shared_folder() -> Path | None:
    named = os.environ.get("POLHODE_SHARED")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared"
    return folder if (folder / "spec").is_dir() else None


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of recordings and truth states; the test is skipped where it is absent."""
    folder = _shared_folder()
    if folder is None:
        pytest.skip("the folder ../shared (recordings, truth states) is not beside this checkout")
    return folder


def _resident() -> int:
    """Bytes of memory that this process holds; 0 where the system does not tell."""
    about = Path("/proc/self/statm")
    if not about.exists():
        return 0
    return int(about.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(scope="module", autouse=True)
def bounded_memory():
    """Compiled programs are kept for as long as the process lives: let go of them in time."""
    yield
    if _resident() > 3 * 2**30:
        jax.clear_caches()
        gc.collect()

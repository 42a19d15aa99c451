"""Settings shared by all tests: one cache of compiled programs, float64 available, strict dtype
promotion, checked annotations, the folder of reference data.
"""

import contextlib
import ctypes
import gc
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# Workers, subprocesses and notebook kernels of a run share their compiled programs.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Reading such a program, XLA warns that the machine lacks features that are its own tuning flags.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
if "PYTEST_XDIST_WORKER" in os.environ:  # one core per worker; XLA reads this when it starts
    os.environ.setdefault("NPROC", "1")

import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Modules whose annotations are checked at every call (see checked.py); imported after this line.
CHECKED = (
    "rotation",
    "inertia",
    "_hamiltonian",
    "_scene",
    "frames",
)
assert not [name for name in sys.modules if name.split(".")[0] == "polhode"]
jaxtyping.install_import_hook([f"polhode.{room}" for room in CHECKED], "checked.checked")


# Tracing creates millions of permanent objects: the garbage collector scans them less often.
gc.set_threshold(200_000, 50, 100)


_MOST = 4 * 2**30
"""Memory [bytes] at which a worker drops its programs; later tests read those that they need from
disk. Without this limit two workers take 24 GB in a complete run."""


def _held() -> int:
    """Resident memory of this process in bytes; 0 if the system does not provide it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Clear JAX's caches when memory grows, so that compiled programs do not accumulate."""
    yield
    if _held() > _MOST:
        jax.clear_caches()
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):  # glibc retains freed memory
            ctypes.CDLL(None).malloc_trim(0)


@contextlib.contextmanager
def _unchecked():
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)


@pytest.fixture
def unchecked():
    """Disable the annotation checks, for tests of how the package itself handles wrong input."""
    with _unchecked():
        yield


_raises = pytest.raises


@contextlib.contextmanager
def _raises_in_its_own_words(expected, **options):
    """``pytest.raises`` for errors that the package raises, not the annotation checks."""
    aside = contextlib.nullcontext() if expected is jaxtyping.TypeCheckError else _unchecked()
    with _raises(expected, **options) as found, aside:
        yield found


pytest.raises = _raises_in_its_own_words


def _shared_folder() -> Path | None:
    named = os.environ.get("POLHODE_SHARED")
    folder = Path(named) if named else ROOT.parent / "shared"
    return folder if (folder / "spec").is_dir() else None


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of recordings and reference states; the test is skipped if it is absent."""
    folder = _shared_folder()
    if folder is None:
        pytest.skip("the folder ../shared (recordings, truth states) is not beside this checkout")
    return folder

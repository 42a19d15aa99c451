"""Settings shared by every test: one folder of compiled programs, float64 available, strict
promotion, annotations checked, the folder of truth files."""

import contextlib
import ctypes
import gc
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# What one process of a run has compiled, the others read: workers, subprocesses, notebook kernels.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# XLA names its own tuning flags as features that the machine lacks when it reads such a program.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
if "PYTEST_XDIST_WORKER" in os.environ:  # one core a worker: XLA reads this when it wakes up
    os.environ.setdefault("NPROC", "1")

import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Rooms whose annotations are checked at every call (see checked.py); imported after this line.
CHECKED = (
    "rotation",
    "inertia",
    "_hamiltonian",
    "_scene",
    "frames",
)
assert not [name for name in sys.modules if name.split(".")[0] == "polhode"]
jaxtyping.install_import_hook([f"polhode.{room}" for room in CHECKED], "checked.checked")


# Tracing makes millions of objects that live: they are looked over for cycles less often.
gc.set_threshold(200_000, 50, 100)


_MOST = 4 * 2**30
"""Bytes that a worker may hold before it drops its programs: the next test reads from the disk
those that it needs again. Two workers that keep the programs of a whole run take 24 GB."""


def _held() -> int:
    """Bytes of memory that this process holds; 0 where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Programs do not pile up over a run."""
    yield
    if _held() > _MOST:
        jax.clear_caches()
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):  # glibc keeps what is freed
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
    """Annotations are not looked at: for tests of what the package itself does with wrong input."""
    with _unchecked():
        yield


_raises = pytest.raises


@contextlib.contextmanager
def _raises_in_its_own_words(expected, **options):
    """``pytest.raises``: what is to fail must fail by the package's own checks and words."""
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
    """The folder of recordings and truth states; the test is skipped where it is absent."""
    folder = _shared_folder()
    if folder is None:
        pytest.skip("the folder ../shared (recordings, truth states) is not beside this checkout")
    return folder

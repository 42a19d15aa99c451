"""[ensemble.arrays]: files of NumPy with a row for each body, left on the disk."""

import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from polhode.files._error import SceneFileError

WIDTHS = {"moments": 3, "wxyz": 4, "omega_body": 3, "momentum_body": 3, "torque": 3}
_POSSIBLE = dict.fromkeys(WIDTHS, "finite numbers") | {
    "moments": "positive moments of which none exceeds the sum of the others",
    "wxyz": "finite numbers, not all 0",
}


def read_arrays(names: Mapping[str, str], bodies: int, scene: Path) -> dict[str, np.ndarray]:
    """The arrays (bodies, width), mapped, every row checked. Raises SceneFileError."""
    return {name: _read(name, written, bodies, scene) for name, written in names.items()}


def _read(name: str, written: str, bodies: int, scene: Path) -> np.ndarray:
    wanted = f"a file of NumPy (.npy) with {bodies} x {WIDTHS[name]} numbers"

    def wrong(problem: str, given: str = written, expected: str = wanted) -> SceneFileError:
        return SceneFileError(scene, f"[ensemble.arrays] {name}", problem, given, expected)

    folder = scene.parent.resolve()
    path = (folder / written).resolve()
    if not path.is_relative_to(folder):
        raise wrong("a link that leaves the folder of the scene", written, f"a file in {folder}")
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # a pipe would be waited for, for ever
            raise wrong("cannot be read: not a regular file")
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    except SceneFileError:
        raise
    except Exception as error:  # a damaged header fails in whichever part of NumPy meets it first
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise wrong(f"cannot be read: {reason[:200]}") from error
    shape = getattr(rows, "shape", None)
    if shape != (bodies, WIDTHS[name]) or rows.dtype.kind not in "fiu":
        kind = getattr(rows, "dtype", type(rows).__name__)
        raise wrong("wrong shape or type", f"{written}: {shape} of {kind}")
    bad = _first_bad(name, rows)
    if bad is not None:
        raise wrong("impossible numbers", f"row {bad}: {rows[bad].tolist()}", _POSSIBLE[name])
    return rows


def possible_moments(moments: Any) -> Any:
    """Which rows (..., 3) of NumPy or JAX are positive and obey the triangle inequality."""
    return (moments.min(axis=-1) > 0) & (2 * moments.max(axis=-1) <= moments.sum(axis=-1))


def _first_bad(name: str, rows: np.ndarray, step: int = 2**20) -> int | None:
    """The first row that no body can have, read bit by bit."""
    for start in range(0, len(rows), step):
        part = np.asarray(rows[start : start + step], np.float64)
        good = np.isfinite(part).all(axis=1)
        if name == "moments":
            good &= possible_moments(part)
        elif name == "wxyz":
            good &= part.any(axis=1)
        if not good.all():
            return start + int(np.argmin(good))
    return None

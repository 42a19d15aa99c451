"""Input checks of all constructors; messages state the value, the requirement and the remedy."""

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

if TYPE_CHECKING:
    from jax.typing import ArrayLike as _ArrayLike

    # Accepted numbers: arrays, scalars, and lists of them, nested up to a batch of matrices. The
    # alias of JAX does not include lists.
    ArrayLike = (
        _ArrayLike
        | Sequence[_ArrayLike]
        | Sequence[Sequence[_ArrayLike]]
        | Sequence[Sequence[Sequence[_ArrayLike]]]
    )
else:  # jaxtyping attaches shapes to array types only
    from jaxtyping import ArrayLike as ArrayLike


def is_concrete(*values: Any) -> bool:
    """Whether no array leaf is traced by jit, vmap or grad, so that all values are available."""
    return not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(values))


def numbers(*arrays: Any) -> Any:
    """NumPy for concrete arrays of this process, ``jax.numpy`` for others.

    NumPy checks a few values without the dispatch of JAX, and while other arrays are traced."""
    return np if is_concrete(arrays) and all(_is_here(x) for x in arrays) else jnp


def on_host(array: Any, weak: bool = False) -> Any:
    """``array`` as a NumPy array if it is concrete and not committed to devices by the user.

    Operations on it then compile nothing. ``weak``: convert weakly typed arrays as well, which
    makes their dtype strong."""
    if not isinstance(array, jax.Array) or not is_concrete(array) or array.committed:
        return array
    return np.asarray(array) if weak or not array.weak_type else array


def _is_here(x: Any) -> bool:
    return getattr(x, "is_fully_addressable", True)


def require(condition: Any, message: str | Callable[[], str]) -> None:
    """Raise ``ValueError(message)`` unless ``condition`` holds everywhere.

    A message may be a function, which is called only then: to format numbers takes longer than most
    checks.
    """
    if not bool(np.all(np.asarray(condition))):
        raise ValueError(message if isinstance(message, str) else message())


def describe(value: Any, limit: int = 8) -> str:
    """A short description of a value passed by the user."""
    array = np.asarray(value)
    if array.size <= limit:
        return np.array2string(array, separator=", ").replace("\n", "")
    return f"array of shape {array.shape}"


_NUMPY = (np.ndarray, np.float32, np.float64)


def require_digits(name: str, given: np.ndarray, times: np.ndarray) -> None:
    """ValueError if rounding ``given`` times to the dtype of ``times`` changes a step by more than
    a tenth."""
    exact, steps = np.diff(given, axis=-1), np.diff(times, axis=-1)
    if np.any(np.abs(steps - exact) > 0.1 * np.abs(exact)):
        raise ValueError(
            f"{name} of up to {np.abs(given).max():.4g} s leave no digits for steps of"
            f" {np.median(np.abs(exact)):.3g} s in {times.dtype}: subtract the first time from all,"
            " or compute in float64 (jax_enable_x64)."
        )


def as_float_array(
    name: str,
    value: Any,
    suffix: Sequence[int | None] = (),
    *,
    finite: bool = True,
    hint: str = "put batch axes first and the components last",
) -> Array:
    """A floating-point array whose trailing axes are ``suffix`` (None: any length).

    Lists and integers get the default float dtype, floating arrays keep theirs. Raises TypeError
    for values that are not arrays of real numbers, ValueError for a wrong shape or, for concrete
    values and with ``finite``, for NaN or infinity. ``hint``: how to correct a wrong shape.
    """
    try:
        leaves = jax.tree.leaves(value, is_leaf=lambda leaf: leaf is None)
        if any(leaf is None or isinstance(leaf, (str, bytes)) for leaf in leaves):
            raise TypeError("no number")  # JAX would interpret some strings as dtypes
        # ``jax.device_put`` of a NumPy array compiles no program, unlike ``jnp.asarray``. An array
        # is copied, because the user may change it later.
        is_plain = isinstance(value, list | tuple) or type(value) is int
        if is_plain and all(type(x) in (float, int) for x in leaves):
            value = jax.device_put(np.array(value, float))
        elif isinstance(value, _NUMPY) and value.dtype in (np.float32, np.float64):
            value = jax.device_put(np.array(value))
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        fix = ": convert it by ph.rotation.scipy_to_wxyz" if hasattr(value, "as_quat") else ""
        raise TypeError(
            f"{name} must be an array of real numbers, got {type(value).__name__}:"
            f" {value!r:.80}{fix}."
        ) from error
    if jnp.issubdtype(array.dtype, jnp.complexfloating) or array.dtype == jnp.bool_:
        raise TypeError(f"{name} must hold real numbers, got dtype {array.dtype}.")
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))
    n = len(suffix)
    tail = array.shape[array.ndim - n :] if n else ()
    fits = array.ndim >= n and all(want in (None, got) for want, got in zip(suffix, tail))
    if not fits:
        expected_shape = ", ".join(["...", *("n" if s is None else str(s) for s in suffix)])
        if tuple(suffix) == (None,):  # any length is valid: the value is a single number
            hint = "give a row of numbers, such as [0.0, 10.0]"
        raise ValueError(f"{name} must have shape ({expected_shape}), got {array.shape}: {hint}.")
    if finite and is_concrete(array) and not bool(np.all(np.isfinite(np.asarray(array)))):
        raise ValueError(
            f"{name} holds NaN or infinity ({describe(array)}): remove or correct these entries"
            " before the call."
        )
    return array


@functools.cache
def _weak_array(values: tuple[float, ...], wide: bool) -> Array:
    del wide  # part of the cache key: arrays of either default precision
    with jax.ensure_compile_time_eval():
        return jnp.stack([jnp.asarray(x) for x in values])


def default_array(values: tuple[float, ...]) -> Array:
    """The default of an argument, weakly typed like a Python number, so that it gets the dtype of
    the other numbers of the scene."""
    return _weak_array(values, bool(jax.config.read("jax_enable_x64")))


def as_vectors(name: str, value: Any, size: int = 3) -> Array:
    """An array (..., size) of floats, also from lists; NaN is accepted. JAX arrays of floats are
    returned without further checks, at no cost."""
    fits = isinstance(value, jax.Array) and value.shape[-1:] == (size,)
    if fits and jnp.issubdtype(value.dtype, jnp.floating):
        return value
    return as_float_array(name, value, (size,), finite=False)


def vectors_like(array: Any, value: Any, name: str = "vector") -> Array:
    """Vectors (..., 3) of floats; lists and integers get the dtype of ``array``."""
    vectors = as_vectors(name, value)
    has_dtype = jnp.issubdtype(getattr(value, "dtype", int), jnp.floating)
    return vectors if has_dtype else vectors.astype(array.dtype)


def as_number(name: str, value: Any) -> Array:
    """A floating-point scalar or batch of scalars."""
    return as_float_array(name, value, ())


def require_positive(
    name: str, array: Any, *, zero: bool = False, hint: str = "check its sign and its units"
) -> None:
    """ValueError if a concrete array contains negative values (or zeros, unless ``zero``)."""
    if not is_concrete(array) or np.size(array) == 0:
        return
    minimum = float(np.min(np.asarray(array)))
    requirement = "not be negative" if zero else "be positive"
    require(
        minimum > 0 or (zero and minimum == 0),
        f"{name} must {requirement}, got {minimum:g}: {hint}.",
    )


def as_positive(name: str, value: Any, **options: Any) -> Array:
    """A floating-point scalar or batch of scalars; see ``require_positive``."""
    number = as_number(name, value)
    require_positive(name, number, **options)
    return number


def batch_of(**arguments: tuple[Array, int]) -> tuple[int, ...]:
    """The common batch axes of arrays ``name=(array, number of trailing axes)``.

    Raises ValueError with all shapes if they do not broadcast together.
    """
    try:
        return np.broadcast_shapes(*(x.shape[: x.ndim - tail] for x, tail in arguments.values()))
    except ValueError as error:
        shapes = ", ".join(f"{name} {x.shape}" for name, (x, _) in arguments.items())
        raise ValueError(f"the batch axes must broadcast together, got {shapes}.") from error


def as_floats(
    *, finite: bool = True, **arguments: tuple[Any, tuple[int | None, ...]]
) -> tuple[Array, ...]:
    """Arrays ``name=(value, suffix)`` of one floating dtype and with common batch axes.

    Python numbers and lists get the dtype of the arrays among the arguments, or the default one if
    there are none. Arrays of several dtypes get the widest one.
    """
    arrays = [
        as_float_array(name, value, suffix, finite=finite)
        for name, (value, suffix) in arguments.items()
    ]
    kinds = [  # dtypes after conversion: without jax_enable_x64, NumPy's float64 becomes float32
        array.dtype
        for array, (value, _) in zip(arrays, arguments.values())
        if hasattr(value, "dtype") and jnp.issubdtype(value.dtype, jnp.floating)
    ]
    if kinds:
        common = kinds[0]
        for kind in kinds[1:]:
            common = jnp.promote_types(common, kind)
        arrays = [array.astype(common) for array in arrays]
    tails = [len(suffix) for _, suffix in arguments.values()]
    batch = batch_of(**dict(zip(arguments, zip(arrays, tails))))
    return tuple(
        jnp.broadcast_to(array, (*batch, *array.shape[array.ndim - tail :]))
        for array, tail in zip(arrays, tails)
    )

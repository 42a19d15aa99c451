"""Parts of a scene: their batch axes, and checks of their fields and of users' functions."""

import dataclasses
import functools
import inspect
import re
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._checks import is_concrete

# Parts: modules whose array fields declare their shape for one body.


def shaped(*core: int | None, **options: Any) -> Any:
    """A field for an array of shape ``(..., *core)``, batch axes first; None: any length."""
    return eqx.field(metadata={"core": core}, **options)


@functools.cache
def _cores(kind: type) -> dict[str, tuple[int | None, ...]]:
    fields = dataclasses.fields(kind)
    return {field.name: field.metadata["core"] for field in fields if "core" in field.metadata}


_UNSHOWN = re.compile(r"(?<=\()\s*\w+=None,|,\s*\w+=None(?=[,\s)])|, weak_type=True")


class Printable(eqx.Module):
    """Base of modules that print their numbers if these are concrete and few, otherwise shapes.

    Fields that are None, and JAX's weak types, are not printed.
    """

    def __str__(self) -> str:
        leaves = jax.tree.leaves(self)
        few = is_concrete(leaves) and sum(map(np.size, leaves)) <= 100
        return _UNSHOWN.sub("", eqx.tree_pformat(self, short_arrays=not few))


class AbstractPart(Printable):
    """Base of all modules that may have batch axes: the state and the parts of a scene.

    Array fields that may differ between bodies are declared by ``shaped``; all other fields are
    common to all bodies.

    ``smooth``: whether the contribution of the part is a smooth function of state and time between
    the edges that it declares. If not, steps are searched for jumps.
    """

    smooth: ClassVar[bool] = True

    @property
    def core_ranks(self) -> dict[str, int]:
        """Rank without batch axes of each array field."""
        return {name: len(core) for name, core in _cores(type(self)).items()}

    @property
    def input_conditions(self) -> tuple[Array, ...]:
        """Conditions (...) on limits and edges, checked in compiled programs as well.

        Comparisons with NaN, or with a limit of the wrong sign, do not make the motion NaN, but the
        motion is wrong and its derivative zero. The status of such a body is ``NOT_FINITE``.
        """
        return ()


def above_zero(*limits: Array | None) -> tuple[Array, ...]:
    """Conditions that limits are positive, and hence not NaN; none for limits that are None."""
    return tuple(limit > 0 for limit in limits if limit is not None)


def all_input_conditions(part: Any) -> tuple[Array, ...]:
    """``input_conditions`` of a part and of the parts inside it."""
    if not isinstance(part, AbstractPart):
        return ()
    names = () if isinstance(part, AbstractSum) else part.core_ranks
    inner = part.terms if isinstance(part, AbstractSum) else [getattr(part, n) for n in names]
    return sum(map(all_input_conditions, inner), start=part.input_conditions)


class AbstractSum(AbstractPart):
    """Base of the sums of parts of one kind; each of the ``terms`` has its own batch axes."""

    terms: tuple[Any, ...]


def summands(part: AbstractPart | None) -> tuple[Any, ...]:
    """The terms of a sum; the part itself if it is not a sum; () for None."""
    if part is None:
        return ()
    return part.terms if isinstance(part, AbstractSum) else (part,)


def check_fields(part: AbstractPart, name: str) -> None:
    """TypeError unless the array fields of a part, and of the parts inside it, contain arrays;
    ValueError for an array of a wrong shape.

    ``eqx.tree_at`` may have put a number, a list or another array there. The constructors cannot
    check this, because ``jax.tree.map``, ``in_axes`` and the masks of optax build parts with other
    objects in these fields. ``name``: the name of the part in messages.
    """
    # A function instead of a method: Equinox builds an object whenever a method is accessed, which
    # takes longer than the check.
    for i, term in enumerate(part.terms if isinstance(part, AbstractSum) else ()):
        check_fields(term, f"{name}.terms[{i}]")
    if type(part).core_ranks is not AbstractPart.core_ranks:  # a class of the user
        missing = [field for field in part.core_ranks if not hasattr(part, field)]
        if missing:
            fields = ", ".join(field.name for field in dataclasses.fields(part))
            raise TypeError(
                f"core_ranks of {type(part).__name__} names {', '.join(missing)}, which is no field"
                f" of it: it has {fields or 'none'}."
            )
    for field, core in _cores(type(part)).items():
        value = getattr(part, field)
        if value is None:
            continue
        if isinstance(value, AbstractPart):
            check_fields(value, f"{name}.{field}")
        elif not (callable(value) or _fits(value, core)):
            _refuse(value, f"{name}.{field}", core)


def _refuse(value: Any, name: str, core: tuple[int | None, ...]) -> None:
    """Raise the error for a value that is not an array of floats (..., *core)."""
    shape = ", ".join(["...", *("n" if size is None else str(size) for size in core)])
    if isinstance(value, _ARRAYS) and jnp.issubdtype(value.dtype, jnp.floating):
        raise ValueError(f"{name} must have shape ({shape}), got {value.shape}.")
    description = (
        f"{value.dtype} array" if isinstance(value, _ARRAYS) else f"{type(value).__name__}"
    )
    raise TypeError(
        f"{name} must be a floating-point array ({shape}), got {description}: {value!r:.60}. Put"
        " jnp.asarray(...) there, or build the part anew."
    )


def terms_of(name: str, kind: type, one: Any, other: Any) -> tuple[Any, ...]:
    """The terms of ``one + other``, either of which may be a sum already.

    TypeError unless ``other`` is of the same ``kind``, called ``name``.
    """
    if not isinstance(other, kind):
        raise TypeError(f"a {name} adds to another {name}, not to {type(other).__name__}")
    return summands(one) + summands(other)


def _fits(value: Any, core: tuple[int | None, ...]) -> bool:
    """Whether a value is an array of floats (..., *core)."""
    if not isinstance(value, _ARRAYS) or value.dtype not in _FLOATS:
        return False
    tail = value.shape[max(0, value.ndim - len(core)) :]
    return len(tail) == len(core) and all(a in (None, b) for a, b in zip(core, tail))


_ARRAYS = (jax.Array, np.ndarray, np.generic)
_FLOATS = tuple(np.dtype(x) for x in (np.float64, np.float32, np.float16, jnp.bfloat16))


# Functions of users: their arguments and results are checked once. As a leaf, a plain function
# would make ``jax.jit`` and ``jax.tree.map`` over a scene fail; it is therefore static data, equal
# to itself only. A function that is a pytree (an ``eqx.Module``, ``jax.tree_util.Partial``) is not
# wrapped: its arrays are leaves of the scene.


_NAMES = {
    "t": {"t", "time", "seconds"},
    "wxyz": {"wxyz", "q", "quat", "quaternion", "attitude"},
    "omega_body": {"omega_body", "omega", "rates", "rate", "angular_velocity"},
    "R": {"R", "r", "rotation", "matrix", "rotation_matrix"},
    "position": {"position", "x", "position_space"},
    "velocity": {"velocity", "v", "velocity_space"},
}
"""Common names of each argument, by which a wrong order of arguments is recognised."""


class Function(eqx.Module):
    """A user's function as static data of a pytree, equal to itself only."""

    fn: Callable = eqx.field(static=True)

    def __call__(self, *args: Any) -> Any:
        return self.fn(*args)


def as_static(fn: Callable) -> Callable:
    """The function, wrapped unless it is a pytree of its own (or wrapped already)."""
    if not jax.tree_util.all_leaves([fn]):
        return fn
    try:
        hash(fn)
    except TypeError:
        fn = functools.partial(fn)  # equal to itself only
    return Function(fn)


def takes(name: str, fn: Any, arguments: Sequence[str]) -> None:
    """TypeError unless ``fn`` takes these arguments, in this order as far as the names of its
    parameters show."""
    call = f"fn({', '.join(arguments)})"
    if not callable(fn):
        raise TypeError(f"{name} takes a function {call}, got {type(fn).__name__}: {fn!r:.80}.")
    if isinstance(fn, type):
        raise TypeError(
            f"{name} takes a function {call}, got the class {fn.__name__}: make an object of it."
        )
    try:
        signature = inspect.signature(fn)
    except (TypeError, ValueError):  # some built-in functions have none
        return
    try:
        bound_arguments = signature.bind(*arguments).arguments
    except TypeError as error:
        raise TypeError(
            f"{name} is called as {call}, but the function given takes {signature} ({error})."
        ) from None
    for parameter, argument in bound_arguments.items():
        expected_argument = next((k for k in arguments if parameter in _NAMES.get(k, ())), None)
        if (
            expected_argument is not None
            and isinstance(argument, str)
            and argument != expected_argument
        ):
            raise TypeError(
                f"{name} is called as {call}, but the function given takes {signature}: its"
                f" {parameter!r} would be given {argument}. Put the arguments in the order {call}."
            )


_TRACED = (
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.ConcretizationTypeError,  # of bool(), float() and complex() too
)


def _remedy_for(error: Exception) -> str:
    """Cause and remedy, in jax.numpy, of an error among ``_TRACED``."""
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return "NumPy cannot compute with it. Use jax.numpy, such as jnp.sin(x) for np.sin(x)"
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return (
            "a Python `if`, `while`, `and`, `or` or `not` depends on it. Choose by"
            " jnp.where(condition, a, b), and combine conditions by & and |"
        )
    if isinstance(error, jax.errors.TracerIntegerConversionError):
        return "a Python index or range depends on it. Index a jnp.array, or use jnp.where"
    return (
        "float(), int(), math functions and .item() cannot convert it. Leave it an array, and use"
        " jax.numpy, such as jnp.sin(x) for math.sin(x)"
    )


def _place_of(error: Exception) -> str:
    """File, line and text of the user's line that raised the error; empty if not found."""
    libraries = tuple(str(Path(m.__file__).parent) for m in (jax, np, eqx) if m.__file__)
    package = str(Path(__file__).parent)
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if not frame.filename.startswith((*libraries, package)) and frame.line:
            return f" in line {frame.lineno} of {Path(frame.filename).name}, `{frame.line}`"
    return ""


def call_traced(call: str, detail: str, fn: Callable, *args: Any) -> Any:
    """``fn(*args)``; ``call``, ``detail``: the description of the call in messages.

    TypeError for NumPy, ``if`` or ``float`` on a traced array, with the line and the remedy; other
    errors of the function get a note that describes the call.
    """
    try:
        return fn(*args)
    except _TRACED as error:
        raise TypeError(
            f"the function given to {call}, needs the value of a traced array{_place_of(error)}:"
            f" {_remedy_for(error)}."
        ) from error
    except Exception as error:
        error.add_note(
            f"This was raised in the function given to {call}{detail}. It is"
            " traced by JAX: write it with jax.numpy, and choose by jnp.where."
        )
        raise


def result_of(
    name: str,
    arguments: Sequence[str],
    fn: Callable,
    shape: tuple[int, ...],
    dtype: Any,
    *args,
    hint: str = "It sees one body at one time: batches are mapped over it.",
) -> Array:
    """``fn(*args)`` as an array of ``shape`` and ``dtype`` (None: its own).

    TypeError or ValueError for any other result, with the result and the requirement; further
    errors as in ``call_traced``.
    """
    call = f"{name}, called as fn({', '.join(arguments)})"
    shapes = ", ".join(f"{k}: {jnp.shape(x)}" for k, x in zip(arguments, args))
    value = call_traced(call, f" with the shapes {shapes}", fn, *args)
    expected = f"an array of shape {shape}" if shape else "a single number"
    try:
        if value is None or any(
            isinstance(leaf, (str, bytes, dict)) or leaf is None
            for leaf in jax.tree.leaves(value, is_leaf=lambda x: x is None or isinstance(x, dict))
        ):
            raise TypeError("no numbers")
        array = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"the function given to {call}, returned {type(value).__name__}: {value!r:.60};"
            f" {expected} is expected."
        ) from error
    if jnp.issubdtype(array.dtype, jnp.complexfloating) or array.dtype == jnp.bool_:
        raise TypeError(
            f"the function given to {call}, returned dtype {array.dtype}; real numbers;"
            f" {expected} is expected."
        )
    if array.shape != shape:
        raise ValueError(
            f"the function given to {call}, returned shape {array.shape}; {expected} is"
            f" expected. {hint}"
        )
    if dtype is None:
        return array
    return array.astype(dtype)


@dataclasses.dataclass(frozen=True, eq=False)
class Signature:
    """Arguments and result of the functions passed to ``name``: shapes for one body at one time."""

    name: str
    arguments: Mapping[str, tuple[int, ...]]
    returns: tuple[int, ...] = ()

    def checked(self, fn: Any) -> Callable:
        """The function (see ``as_static``) after a check of its arguments and its result, by
        tracing it once with arguments of these shapes."""
        takes(self.name, fn, tuple(self.arguments))
        fn = as_static(fn)
        dtype = jnp.result_type(float)
        shapes = self.arguments.values()
        weak = [jax.ShapeDtypeStruct(s, dtype, weak_type=True) for s in shapes]  # of any dtype
        with jax.numpy_dtype_promotion("standard"):  # the precision of the scene is not yet known
            jax.eval_shape(lambda *args: self._result(fn, None, *args), *weak)
        return fn

    def mapped(self, fn: Callable, *args: Any) -> Array:
        """``fn`` mapped over the leading axes of its arguments: (..., *returns) of their dtype."""
        arrays = [x for x in args if hasattr(x, "dtype")]
        dtype = jnp.result_type(*arrays) if arrays else None
        inputs, outputs = (
            ",".join(f"({','.join(map(str, shape))})" for shape in shapes)
            for shapes in (self.arguments.values(), [self.returns])
        )
        return jnp.vectorize(
            lambda *args: self._result(fn, dtype, *args), signature=f"{inputs}->{outputs}"
        )(*args)

    def _result(self, fn: Callable, dtype: Any, *args: Any) -> Array:
        return result_of(self.name, tuple(self.arguments), fn, self.returns, dtype, *args)

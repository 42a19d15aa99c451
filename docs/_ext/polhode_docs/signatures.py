"""Signatures as they are written in the source.

Evaluated annotations are long (`ArrayLike` is a union of ten types); what stands in the source is
what a caller reads in an editor.
"""

import ast
import copy
import enum
import inspect
import textwrap
from collections.abc import Callable

SHAPED = {"Bool", "Complex", "Float", "Inexact", "Int", "Key", "Num", "Real", "Shaped", "UInt"}
"""Types of jaxtyping: the string in `Float[Array, "*b 3"]` is a shape, not a type."""


class _Annotations(ast.NodeTransformer):
    """Forward references ("Trajectory") without their quotes."""

    def visit_Subscript(self, node):
        base = ast.unparse(node.value).rpartition(".")[2]
        return node if base in SHAPED | {"Literal"} else self.generic_visit(node)

    def visit_Constant(self, node):
        if isinstance(node.value, str):
            return ast.parse(node.value, mode="eval").body
        return node


def annotation_text(node: ast.expr | None) -> str | None:
    if node is None:
        return None
    return ast.unparse(_Annotations().visit(copy.deepcopy(node)))


def definition(thing: Callable) -> ast.FunctionDef | None:
    """The `def` of a function, None where it has no source (made by a decorator)."""
    try:
        source = textwrap.dedent(inspect.getsource(inspect.unwrap(thing)))
        node = ast.parse(source).body[0]
    except (OSError, TypeError, SyntaxError):
        return None
    return node if isinstance(node, ast.FunctionDef) else None


def of_function(thing: Callable) -> tuple[str, str | None] | None:
    """Arguments and return annotation of a function or method."""
    node = definition(thing)
    if node is None:
        return None
    arguments = copy.deepcopy(node.args)
    for group in (arguments.posonlyargs, arguments.args):
        if group and group[0].arg in ("self", "cls"):
            del group[0]
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    for argument in [*every, arguments.vararg, arguments.kwarg]:
        if argument is not None and argument.annotation is not None:
            argument.annotation = _Annotations().visit(argument.annotation)
    return f"({ast.unparse(arguments)})", annotation_text(node.returns)


def of_property(thing: property) -> str | None:
    """The annotation of what a property returns."""
    node = definition(thing.fget) if thing.fget is not None else None
    return None if node is None else annotation_text(node.returns)


def of_class(cls: type) -> str | None:
    """The arguments of a constructor: of `__init__`, or the fields of a dataclass or tuple.

    None for enumerations and for exceptions that add nothing to `Exception`.
    """
    if issubclass(cls, enum.Enum):
        return None
    node = definition(cls.__init__)
    if node is not None and node.name == "__init__":
        return of_function(cls.__init__)[0]
    if issubclass(cls, Exception):
        return None
    return f"({', '.join(_fields(cls))})"


def _fields(cls: type) -> list[str]:
    """Fields as arguments, annotated as in the class that declares them."""
    declared = {}
    for base in reversed(cls.__mro__):
        try:
            node = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        except (OSError, TypeError, SyntaxError):
            continue
        for line in node.body if isinstance(node, ast.ClassDef) else ():
            if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                declared[line.target.id] = line
    texts = []
    keyword_only = False
    for name, parameter in inspect.signature(cls).parameters.items():
        if parameter.kind is parameter.KEYWORD_ONLY and not keyword_only:
            texts.append("*")
            keyword_only = True
        line = declared.get(name)
        text = name if line is None else f"{name}: {annotation_text(line.annotation)}"
        if parameter.default is not parameter.empty:
            text += f" = {_default(line, parameter.default)}"
        texts.append(text)
    return texts


def _default(line: ast.AnnAssign | None, value: object) -> str:
    if line is None or line.value is None:
        return repr(value)
    if isinstance(line.value, ast.Call):  # field(default=...)
        plain = value is None or isinstance(value, int | float | str | tuple)
        return repr(value) if plain else "..."
    return ast.unparse(line.value)

"""The public names of polhode, read from the stub that lists them, ``__init__.pyi``."""

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polhode as ph

STUB = Path(ph.__file__).with_suffix(".pyi")


def stub_names(path: Path = STUB) -> list[str]:
    """Names that the stub re-exports, in their order there."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imports = (node for node in tree.body if isinstance(node, ast.ImportFrom))
    return [name.asname or name.name for node in imports for name in node.names]


def namespaces() -> list[str]:
    """The public submodules."""
    return [name for name in stub_names() if inspect.ismodule(getattr(ph, name))]


def namespace_names(namespace: str) -> list[str]:
    """Public names of a namespace: what its module defines or re-exports from polhode."""
    module = getattr(ph, namespace)
    names = [name for name in dir(module) if not name.startswith("_")]
    return [
        name
        for name in names
        if not inspect.ismodule(value := getattr(module, name))
        and getattr(value, "__module__", "").startswith("polhode")
    ]


def public_objects() -> Iterator[tuple[str, Any]]:
    """Every public class and function once, by the first of its names."""
    listed: list[Any] = []
    names = [name for name in stub_names() if name not in namespaces()]
    names += [f"{space}.{name}" for space in namespaces() for name in namespace_names(space)]
    for name in names:
        value: Any = ph
        for part in name.split("."):
            value = getattr(value, part)
        if not any(value is other for other in listed):
            listed.append(value)
            yield name, value

"""The public names of polhode, read from its source, and the pages of the reference.

Nothing of polhode is imported here: the tests compare this list with the package.
"""

import ast
import re
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[3] / "src" / "polhode"


def _statements(path: Path):
    """The explicit re-exports (`from a import b as b`) of a module or stub, in their order."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if alias.asname == alias.name and not alias.name.startswith("_"):
                    yield node, alias.name


def namespaces() -> list[str]:
    """The public subpackages that the stub names (`from . import rotation as rotation`)."""
    return [
        name
        for node, name in _statements(PACKAGE / "__init__.pyi")
        if node.level == 1 and node.module is None
    ]


def names_in(namespace: str = "") -> list[str]:
    """The public functions, classes and types of `polhode` or of one of its namespaces."""
    folder = PACKAGE / namespace
    stub = folder / "__init__.pyi"
    path = stub if stub.exists() else folder / "__init__.py"
    left_out = namespaces() if not namespace else []
    return [name for _, name in _statements(path) if name not in left_out]


def public_names() -> list[str]:
    """Every public name with its package, such as `polhode.rotation.multiply`."""
    found = [f"polhode.{name}" for name in names_in()]
    for namespace in namespaces():
        found.append(f"polhode.{namespace}")
        found += [f"polhode.{namespace}.{name}" for name in names_in(namespace)]
    return found


def grouped() -> dict[str, tuple[str, str, list[str]]]:
    """The pages of `polhode`: title, introduction, names, by the headings of the stub.

    A heading is a comment `# Title: introduction` at the start of a line; the names of the imports
    below it, up to the next heading, stand on its page. The namespaces have pages of their own.
    """
    text = (PACKAGE / "__init__.pyi").read_text(encoding="utf-8")
    headings = [
        (number, *match.groups())
        for number, line in enumerate(text.splitlines(), 1)
        if (match := re.fullmatch(r"# ([^:]+): (.+)", line))
    ]
    pages: dict[str, tuple[str, str, list[str]]] = {}
    for node, name in _statements(PACKAGE / "__init__.pyi"):
        if node.module is None:
            continue
        above = [heading for heading in headings if heading[0] < node.lineno]
        if not above:
            raise ValueError(f"{name} stands above the first heading of the stub")
        _, title, text = above[-1]
        page = re.sub(r"\W+", "_", title.lower())
        pages.setdefault(page, (title, text[0].upper() + text[1:], []))[2].append(name)
    return pages

"""Execute the notebooks from their text forms and store the outputs: ``make notebooks``.

    python tests/stored_outputs.py [NAME ...]

writes notebooks/NAME.ipynb, by default for all notebooks. The metadata of each notebook contain a
stamp: the version of polhode, and hashes of the cells and of the signatures of the public names
that the notebook uses. A fast test compares the stamp; a slow test executes the notebooks again and
compares their outputs.
"""

import hashlib
import importlib
import inspect
import json
import os
import re
import sys
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

import polhode as ph

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "notebooks"
SECONDS = 900  # for one cell
sys.path.append(str(ROOT / "docs" / "_ext"))

from polhode_docs import public_names

NUMBER = re.compile(r"(?<![\w.])[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?![\w])")
RELATIVE = 1e-6
ROUNDING = 1e-10
"""Deviations below this are rounding: only their smallness is compared."""


def executed(name: str) -> nbformat.NotebookNode:
    """The notebook of a text form, executed by a kernel that imports this polhode, with a stamp."""
    book = jupytext.read(FOLDER / f"{name}.py")
    probe = nbformat.v4.new_code_cell("import polhode\nprint(polhode.__file__)")
    book.cells.append(probe)
    client = NotebookClient(
        book,
        timeout=SECONDS,
        kernel_name="python3",
        record_timing=False,
        resources={"metadata": {"path": str(FOLDER)}},
    )
    source = str(Path(ph.__file__).resolve().parents[1])
    client.execute(env=os.environ | {"PYTHONPATH": source})
    imported = "".join(output.text for output in book.cells.pop().outputs).strip()
    if Path(imported).resolve() != Path(ph.__file__).resolve():
        raise RuntimeError(f"the kernel imports {imported}, not {ph.__file__}")
    for number, cell in enumerate(book.cells):
        cell.id = f"cell-{number}"  # reproducible
        if cell.cell_type == "code":
            cell.outputs = merged(cell.outputs)
    book.metadata["language_info"] = {"name": "python", "pygments_lexer": "ipython3"}
    book.metadata["polhode"] = stamp(name)
    return book


def merged(outputs: list) -> list:
    """Outputs with the pieces of a stream joined, since their number depends on timing."""
    streams, others = {}, []
    for output in outputs:
        if output.output_type != "stream":
            others.append(output)
        elif output.name in streams:
            streams[output.name].text += output.text
        else:
            streams[output.name] = output
            others.append(output)
    return others


def stamp(name: str) -> dict[str, str]:
    """Version of polhode, and hashes of the notebook's cells and of the interface that it uses."""
    book = jupytext.read(FOLDER / f"{name}.py")
    cells = [[cell.cell_type, cell.source] for cell in book.cells]
    code = "\n".join(cell.source for cell in book.cells if cell.cell_type == "code")
    return {
        "version": ph.__version__,
        "cells": digest(cells),
        "interface": digest(interface(set(re.findall(r"[A-Za-z_]\w*", code)))),
    }


def interface(words: set[str]) -> dict[str, str]:
    """Parameters of the public functions, classes and methods whose names are in ``words``."""
    found = {}
    for full in public_names.public_names():
        module, _, last = full.rpartition(".")
        thing = getattr(importlib.import_module(module), last)
        if last not in words or inspect.ismodule(thing):
            continue
        found[full] = parameters(thing)
        members = inspect.getmembers(thing) if inspect.isclass(thing) else []
        for member, value in members:
            if member in words and not member.startswith("_"):
                found[f"{full}.{member}"] = parameters(value)
    return found


def parameters(thing: object) -> str:
    """Names and kinds of the parameters, without defaults, whose text may depend on versions."""
    try:
        signature = inspect.signature(thing)
    except (TypeError, ValueError):
        return type(thing).__name__
    return ", ".join(
        f"{p.name}{'' if p.default is p.empty else '='}" for p in signature.parameters.values()
    )


def digest(value: object) -> str:
    text = json.dumps(value, sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def texts(book: nbformat.NotebookNode) -> list[tuple[int, str, bool]]:
    """(number of the cell, text, whether it contains timings) of every output that is text."""
    found = []
    for number, cell in enumerate(book.cells):
        timed = "timing" in cell.metadata.get("tags", [])
        for output in cell.get("outputs", []):
            if output.output_type == "stream":
                found.append((number, output.text, timed))
            elif "data" in output:
                found.append((number, output.data.get("text/plain", ""), timed))
    return found


def difference(stored: str, new: str, *, timed: bool = False) -> str | None:
    """Where two texts differ by more than the last digits of their numbers; None if nowhere.

    Numbers agree to a relative error of 1e-6 or to one unit of the last printed digit. Numbers of
    one or two digits with an exponent, such as 3e-09, are sizes of errors: they agree within a
    factor of 10. Numbers below 1e-10 agree with each other. ``timed``: numbers are timings and not
    compared.
    """
    words = [NUMBER.sub("#", text).split() for text in (stored, new)]
    words = [[w.strip("[]") for w in row if w.strip("[]")] for row in words]  # padding of arrays
    if words[0] != words[1]:
        at = next((k for k, pair in enumerate(zip(*words)) if pair[0] != pair[1]), -1)
        return f"{' '.join(words[0])!r} became {' '.join(words[1])!r} (word {at})"
    if timed:
        return None
    for old, other in zip(NUMBER.findall(stored), NUMBER.findall(new), strict=True):
        if not numbers_agree(old, other):
            return f"{old} became {other} in {stored!r}"
    return None


def numbers_agree(old: str, new: str) -> bool:
    a, b = float(old), float(new)
    if a == b or max(abs(a), abs(b)) < ROUNDING:
        return True
    if all("e" in x.lower() and digits(x) <= 2 for x in (old, new)):
        low, high = sorted((max(abs(a), ROUNDING), max(abs(b), ROUNDING)))
        return high <= 10 * low
    return abs(a - b) <= max(RELATIVE * max(abs(a), abs(b)), 1.01 * max(unit(old), unit(new)))


def digits(number: str) -> int:
    return sum(c.isdigit() for c in re.split("[eE]", number)[0])


def unit(number: str) -> float:
    """One unit in the last printed place; zero for an integer."""
    mantissa, _, exponent = number.lower().partition("e")
    places = len(mantissa.partition(".")[2])
    return 10.0 ** (int(exponent or 0) - places) if "." in mantissa or exponent else 0.0


def main(names: list[str]) -> None:
    for name in names or sorted(path.stem for path in FOLDER.glob("*.py")):
        book = executed(name)
        nbformat.write(book, FOLDER / f"{name}.ipynb")
        print(name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

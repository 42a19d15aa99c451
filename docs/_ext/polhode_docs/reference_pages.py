"""The source of the reference: a page of autodoc directives for each group of public names."""

import enum
import importlib
import inspect
import re
from pathlib import Path

from polhode_docs.public_names import grouped, names_in, namespaces

LITERAL = re.compile(r"(``.+?``|`[^`]+`)")
SPECIAL = re.compile(r"\||(?<!\*)\*(?!\*)")
ITEM = re.compile(r"\s*(-|\d+\.) ")
PAGE = re.compile(r"\bdocs/([\w/-]+)\.md\b")

INTERNAL = {
    # of scenes and their parts, while a simulation is prepared
    "settled", "carrier", "changes", "dynamics",
    "with_spins", "without_wheels", "as_unit", "check_form", "check_within", "of_symmetry",
    "settle", "column", "core_ranks", "smooth",
    # of methods and solvers, inside the integration
    "objection", "why_not", "refuse", "exact", "keeps_rtol", "stepping", "spanning",
    "bodies_at_once", "evaluations", "error_order", "term_structure", "interpolation_cls",
    "init", "func", "step", "loop", "parts", "check",
    # of events, fits and files
    "polished", "lanes", "model_config", "model_post_init", "rows",
}  # fmt: skip
"""Members that other modules of polhode use and that users have no use for."""


INTRODUCTION = """Reference
=========

Every public name, in the order of ``polhode/__init__.pyi``; ``ph`` is ``polhode``.

.. list-table::
   :widths: 40 60

   * - the motion of a body
     - :py:obj:`ph.simulate <polhode.simulate>` of a :py:obj:`ph.Scene <polhode.Scene>`; for events
       :py:obj:`ph.crossings <polhode.crossings>` or ``until=``
   * - one step with its Jacobian
     - :py:obj:`ph.propagate <polhode.propagate>`
   * - the periods of a free motion
     - :py:obj:`ph.periods <polhode.periods>`
   * - an inertia
     - three different moments: ``Inertia.from_moments``; equal by construction: ``axisymmetric``,
       ``spherical``; in other axes: ``from_tensor``; from solids and meshes: ``MassProperties``
   * - a force
     - with an energy: a potential; given in time: ``BodyTorque``, ``SpaceTorque``, ``Pulses``; by
       the state: ``FeedbackTorque`` (:doc:`more </how-to/write_a_torque>`)
   * - a method
     - none: polhode chooses (:doc:`how </methods>`); or ``LiePoisson``, ``EulerAngles`` with a
       solver of diffrax
   * - a fit
     - ``fit_inertia`` for one recording, ``fit_recordings`` for several, ``fit_scene`` for other
       parameters (:doc:`more </how-to/fit_a_recording>`)
"""


def left_out(thing: type) -> list[str]:
    """Members of a class that its entry leaves out: internal ones, and those that its entry's link
    to a public abstract base documents, such as ``body_components`` of a torque."""
    bases = [base for base in thing.__mro__[1:] if base.__name__.startswith("Abstract")]
    own = [name for name in vars(thing) if not name.startswith("_")]
    return [x for x in own if x in INTERNAL or any(x in vars(base) for base in bases)]


def pages() -> dict[str, str]:
    """The source of every page of the reference, by its file name."""
    home: dict[object, str] = {}  # of an object with two public names, the first one documented
    made = {}
    for page, (title, text, names) in grouped().items():
        made[f"{page}.rst"] = _page(title, text, "polhode", names, home)
    for namespace in namespaces():
        module = f"polhode.{namespace}"
        about = inspect.getdoc(importlib.import_module(module)) or ""
        body = _page(module, markup(about), module, names_in(namespace), home)
        made[f"{namespace}.rst"] = f"{body}\n"
    return {"index.rst": _index(list(made)), **made}


def _page(title: str, text: str, module: str, names: list[str], home: dict) -> str:
    parts = [f"{title}\n{'=' * len(title)}"]
    parts.append(
        f".. py:module:: {module}" if title == module else f".. py:currentmodule:: {module}"
    )
    parts.append(text)
    for name in names:
        full = f"{module}.{name}"
        thing = resolve(full)
        if not isinstance(thing, type) and not callable(thing):  # a type alias, a constant
            parts.append(f".. autodata:: {full}\n   :no-value:")
        elif id(thing) in home:
            kind = "class" if isinstance(thing, type) else "function"
            parts.append(f".. py:{kind}:: {name}\n\n   The same as :py:obj:`{home[id(thing)]}`.")
        elif isinstance(thing, type):
            values = "\n   :undoc-members:" if issubclass(thing, enum.Enum) else ""
            hidden = ", ".join(left_out(thing))
            hidden = f"\n   :exclude-members: {hidden}" if hidden else ""
            parts.append(f".. autoclass:: {full}\n   :members:{values}{hidden}")
        else:
            parts.append(f".. autofunction:: {full}")
        home.setdefault(id(thing), full)
    return "\n\n".join(parts) + "\n"


def _index(files: list[str]) -> str:
    rows = []
    for title, module, names in _contents():
        rows.append(f".. rubric:: {title}\n")
        rows.append(".. list-table::\n   :widths: 30 70\n   :class: names\n")
        for name in names:
            first = (inspect.getdoc(resolve(f"{module}.{name}")) or "").split("\n\n")[0]
            rows.append(f"   * - :py:obj:`{name} <{module}.{name}>`")
            rows.append(f"     - {markup(' '.join(first.split()))}")
        rows.append("")
    tree = "\n".join(f"   {Path(name).stem}" for name in files)
    return f"{INTRODUCTION}\n.. toctree::\n   :hidden:\n\n{tree}\n\n" + "\n".join(rows) + "\n"


def _contents():
    for _, (title, _, names) in grouped().items():
        yield title, "polhode", names
    for namespace in namespaces():
        yield f"polhode.{namespace}", f"polhode.{namespace}", names_in(namespace)


def resolve(full: str) -> object:
    module, _, name = full.rpartition(".")
    return getattr(importlib.import_module(module), name)


def markup(text: str) -> str:
    """A docstring, which is simple Markdown, as reStructuredText.

    Blocks indented by four spaces are code, `|` and a lone `*` are themselves, and pages of the
    documentation that are named become links.
    """
    lines: list[str] = []
    before, base, in_code = "", 0, False
    for line in text.split("\n"):
        indent = len(line) - len(line.lstrip())
        if line.strip():
            if in_code:
                in_code = indent >= base + 4
            elif not before and indent >= base + 4:
                in_code = True
                lines += [f"{' ' * base}.. code-block:: python", ""]
            if not in_code:
                base = 2 if ITEM.match(line) else min(base, indent)
                if lines and before and lines[-1].startswith(" " * 4) and indent < 4:
                    lines.append("")  # text follows code directly
        lines.append(line if in_code else "".join(map(_escape, LITERAL.split(line))))
        before = line.strip()
    return PAGE.sub(r":doc:`docs/\1.md </\1>`", "\n".join(lines))


def _escape(text: str) -> str:
    return text if LITERAL.fullmatch(text) else SPECIAL.sub(r"\\\g<0>", text)

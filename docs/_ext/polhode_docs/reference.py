"""The reference: one page for each group of public names, by autodoc, linked from everywhere."""

import inspect
import re
from pathlib import Path

from docutils import nodes
from sphinx import addnodes

from polhode_docs import signatures
from polhode_docs.pages import remove_others, write_if_changed
from polhode_docs.public_names import namespaces, public_names
from polhode_docs.reference_pages import markup, pages, resolve

NAME = re.compile(r"(ph\.|polhode\.)?((?:\w+\.)*\w+)(?:\(.*\))?")
WORD = re.compile(r"""((?<![\w"'*# ])[A-Za-z_][\w.]*|(?<=[|,\[] )[A-Za-z_][\w.]*)""")
EXTERNAL = {
    "Array": "jax.Array",
    "ArrayLike": "jax.typing.ArrayLike",
    "np.ndarray": "numpy.ndarray",
    "Callable": "collections.abc.Callable",
    "Iterable": "collections.abc.Iterable",
    "Iterator": "collections.abc.Iterator",
    "Sequence": "collections.abc.Sequence",
    "Mapping": "collections.abc.Mapping",
    "Path": "pathlib.Path",
    "Any": "typing.Any",
    "Self": "typing.Self",
    "Literal": "typing.Literal",
}
"""Where names of annotations are documented, if not here."""


def write_pages(app) -> None:
    folder = Path(app.srcdir) / "reference"
    made = pages()
    for name, text in made.items():
        write_if_changed(folder / name, text)
    remove_others(folder, set(made))


# Docstrings and signatures ----------------------------------------------------------------------


def process_docstring(app, what, name, obj, options, lines) -> None:
    lines[:] = markup("\n".join(lines)).split("\n")


def process_signature(app, what, name, obj, options, signature, returns):
    if what in ("class", "exception"):
        return signatures.of_class(obj), None
    if what in ("function", "method"):
        return signatures.of_function(obj)
    return None


def write_annotations(app, doctree) -> None:
    """The annotations of properties, which no event of autodoc lets change."""
    for node in doctree.findall(addnodes.desc):
        if node["objtype"] != "property":
            continue
        signature = next(node.findall(addnodes.desc_signature))
        owner, _, name = signature["fullname"].rpartition(".")
        thing = inspect.getattr_static(resolve(f"{signature['module']}.{owner}"), name)
        text = signatures.of_property(thing) if isinstance(thing, property) else None
        shown = list(signature.findall(addnodes.desc_annotation))
        if text is None or not shown[-1].astext().startswith(":"):
            continue
        shown[-1].children = []
        shown[-1] += addnodes.desc_sig_punctuation("", ":")
        shown[-1] += nodes.Text(" ")
        shown[-1] += [_part(part, signature["module"]) for part in WORD.split(text) if part]


def _part(text: str, module: str) -> nodes.Node:
    if not WORD.fullmatch(text):
        return nodes.Text(text)
    link = addnodes.pending_xref("", nodes.Text(text), refdomain="py", reftype="class")
    link.update_all_atts({"reftarget": text, "py:module": module})
    return link


def skip_member(app, what, name, obj, skip, options):
    """Leave out what serves the library itself, and fields that only restate the signature."""
    doc = getattr(obj, "__doc__", None) or ""
    if name == "core_ranks" or doc.startswith("Alias for field number"):
        return True
    return None


# Links ------------------------------------------------------------------------------------------


def complete_targets(app, doctree) -> None:
    """Names in annotations, as the source writes them: of polhode, or of another project."""
    public = set(public_names())
    for node in doctree.findall(addnodes.pending_xref):
        if node.get("refdomain") != "py":
            continue
        target = node["reftarget"].removeprefix("ph.").removeprefix("polhode.")
        spaces = [node.get("py:module") or "polhode", "polhode"]
        spaces += [f"polhode.{space}" for space in namespaces()]
        full = next(
            (f"{space}.{target}" for space in spaces if f"{space}.{target}" in public), None
        )
        if full is not None:
            node["reftarget"] = full
        elif target in EXTERNAL:
            node["reftarget"] = EXTERNAL[target]
        else:
            continue
        if node.hasattr("refspecific"):
            del node["refspecific"]


def _link(app, document: str, entry, full: str, content):
    uri = app.builder.get_relative_uri(document, entry.docname)
    link = nodes.reference("", "", content, internal=True, reftitle=full)
    link["refuri"] = f"{uri}#{entry.node_id}"
    return link


def link_literals(app, doctree, document) -> None:
    """Let `ph.simulate` in a text lead to its entry, and `Trajectory.status` to its class."""
    objects = app.env.domains.python_domain.objects
    for node in list(doctree.findall(nodes.literal)):
        match = NAME.fullmatch(node.astext())
        if match is None or isinstance(node.parent, nodes.reference | addnodes.pending_xref):
            continue
        parts = match[2].split(".")
        if not (match[1] or len(parts) > 1 or parts[0][0].isupper()):
            continue  # a word such as `scene` or `energy`
        for size in range(len(parts), 0, -1):
            full = ".".join(("polhode", *parts[:size]))
            if full in objects:
                node.replace_self(_link(app, document, objects[full], full, node.deepcopy()))
                break


def setup(app):
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-docstring", process_docstring)
    app.connect("autodoc-process-signature", process_signature)
    app.connect("autodoc-skip-member", skip_member)
    app.connect("doctree-read", write_annotations)
    app.connect("doctree-read", complete_targets)
    app.connect("doctree-resolved", link_literals)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

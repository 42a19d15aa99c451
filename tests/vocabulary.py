"""Words that names and docstrings of polhode avoid: ``python tests/vocabulary.py`` lists them.

The glossary (docs/glossary.md) contains the terms to use instead.
"""

import inspect
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "docs" / "_ext"))

from polhode_docs import public_names, reference_pages

RETIRED = {
    r"tell|tells|told|telling": "state, show, report",
    r"ask|asks|asked|asking": "request; depend on",
    r"look|looks|looked|looking": "sample, check, search",
    r"mend|mends|mended|mending|cure": "correct, fix",
    r"march|marches|marched|stepped": "integrate",
    r"slope|slopes": "derivative",
    r"chart|charts": "coordinates",
    r"exact law|exact laws": "closed-form solution",
    r"room|rooms|road|roads|house": "capacity; module, path",
    r"steady|sway|pace|heft|stir": "permanent rotation, regular precession, mean rate, ...",
    r"remark|remarks|surprise|likeliest|learnt": "warning; negative log-likelihood; most probable",
    r"arrive|arrives|arrived|on the way|on its way": "finish; during the motion",
    r"anew|made good|worked out": "again; computed",
    r"wanted|wants": "requested, required",
}
"""Pattern of whole words -> what to write in its place."""

BARE = {
    "turned",
    "moved",
    "mended",
    "settled",
    "polished",
    "given",
    "known",
    "found",
    "kept",
    "held",
    "made",
    "told",
    "asked",
    "wanted",
    "rest",
    "whole",
    "left",
    "gone",
    "most",
    "least",
    "near",
    "slope",
    "slopes",
    "look",
    "looks",
    "march",
    "room",
}
"""Names of functions, parameters and fields that say no noun and no verb of the field."""

PATTERN = re.compile(rf"\b({'|'.join(RETIRED)})\b", re.IGNORECASE)


def resolve(full: str):
    module, _, name = full.rpartition(".")
    return getattr(import_module(module), name)


def described() -> Iterator[tuple[str, object]]:
    """Every public function and class, and their public methods and properties, each once."""
    seen: set[int] = set()
    for full in public_names.public_names():
        thing = resolve(full)
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        yield full, thing
        if not inspect.isclass(thing) or not thing.__module__.startswith("polhode"):
            continue
        for name, member in list(vars(thing).items()):
            member = member.fget if isinstance(member, property) else member
            member = getattr(member, "__func__", member)
            hidden = name.startswith("_") or name in reference_pages.INTERNAL
            if callable(member) and not hidden:
                yield f"{full}.{name}", member


def retired_words(text: str) -> list[str]:
    """Retired words in a docstring, ignoring code."""
    prose = re.sub(r"``.*?``|^ {4,}\S.*$", " ", text, flags=re.MULTILINE)
    return [match[0].lower() for match in PATTERN.finditer(prose)]


def names_of(full: str, thing) -> Iterator[str]:
    yield full.rpartition(".")[2]
    try:
        yield from inspect.signature(thing).parameters
    except (TypeError, ValueError):
        return


def violations() -> tuple[dict[str, list[str]], set[str]]:
    """Docstrings with retired words, and public names in ``BARE``."""
    words = {}
    bare = set()
    for full, thing in described():
        found = retired_words(inspect.cleandoc(thing.__doc__ or ""))
        if found:
            words[full] = found
        bare |= {f"{full}: {name}" for name in names_of(full, thing) if name in BARE}
    return words, bare


if __name__ == "__main__":
    words, bare = violations()
    for name, found in words.items():
        print(name, *found)
    print(*sorted(bare), sep="\n")

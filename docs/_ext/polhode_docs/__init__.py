"""What Sphinx is told beyond its configuration: the reference, notebooks, formulas as MathML.

`public_names`, `reference_pages` and `signatures` need nothing of Sphinx: tests read them.
"""

r"""Formulas as MathML, which browsers lay out themselves: no script, no network.

`\tag{...}` becomes a number at the right margin, with an anchor `equation-...` to link to.
"""

import re

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.errors import ExtensionError

TAG = re.compile(r"\\tag\{([^}]*)\}\s*(?=[.,;]?\s*$)")


def visit_math(translator, node) -> None:
    translator.body.append(mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def visit_math_block(translator, node) -> None:
    text = node.astext()
    tag = TAG.search(text)
    number = tag[1] if tag else node.get("number")
    formula = mathml(TAG.sub("", text), "block")
    translator.body.append(translator.starttag(node, "div", CLASS="math"))
    translator.body.append(f'<div class="formula">{formula}</div>')
    if number is not None:
        anchor = f"equation-{number}"
        translator.body.append(
            f'<a class="eqno" id="{anchor}" href="#{anchor}" title="Link to this equation">'
            f"({number})</a>"
        )
    translator.body.append("</div>\n")
    raise nodes.SkipNode


SPACING = (
    # a solidus and bars without the spaces of an infix operator
    (re.compile(r"<mo ([^>]*)>(&#x0007C;|\||/)</mo>"), r'<mo \1 lspace="0" rspace="0">\2</mo>'),
    (re.compile(r"<mo>&#x0002F;</mo>"), '<mo lspace="0" rspace="0">/</mo>'),
    # a thin space between the name of a function and an argument without parentheses
    (
        re.compile(
            r"((?:<msup>)?<mi>(?:sinh?|cosh?|tanh?|ln|log|exp)</mi>(?:<mn>\d</mn></msup>)?)"
            r"(?=<m(?!o|space))"
        ),
        r'\1<mspace width="0.167em" />',
    ),
    # a sign, not a difference
    (
        re.compile(
            r"(<mo>(?:&#x0003D;|&#x0002C;|&#x02192;|&#x02265;|&#x02264;|&lt;|&gt;)</mo>)<mo>"
        ),
        r'\1<mo form="prefix">',
    ),
    (re.compile(r"<mo>&#x02202;</mo>"), "<mi>&#x02202;</mi>"),
    (re.compile(r'width="negativethinmathspace"'), 'width="-0.167em"'),
)
"""What browsers space otherwise than TeX does."""


def mathml(text: str, display: str) -> str:
    try:
        formula = convert(text.strip(), display=display)
    except Exception as error:
        raise ExtensionError(f"this formula cannot become MathML: {text!r}: {error!r}") from error
    for pattern, replacement in SPACING:
        formula = pattern.sub(replacement, formula)
    return formula


def setup(app):
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}

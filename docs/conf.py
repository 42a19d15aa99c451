"""Configuration of Sphinx: `make docs` builds site/ without a network."""

import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent / "src"), str(DOCS / "_ext")]

REPOSITORY = "https://github.com/polhode/polhode"  # as in the badges of the notebooks

project = "polhode"
author = "The polhode authors"
copyright = author
import polhode

release = version = polhode.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "polhode_docs.mathml",
    "polhode_docs.pages",
    "polhode_docs.reference",
]
exclude_patterns = ["_ext", "inventories"]

# Text
myst_enable_extensions = ["deflist", "dollarmath", "attrs_inline"]
myst_heading_anchors = 4
myst_dmath_double_inline = True
nb_execution_mode = "off"  # notebooks are shown with the outputs they are stored with
nb_merge_streams = True
default_role = "code"
html_math_renderer = "mathml"

# Reference
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_inherit_docstrings = False
maximum_signature_line_length = 88
python_use_unqualified_type_names = True
add_module_names = False
toc_object_entries_show_parents = "hide"
viewcode_line_numbers = True
# Stored lists of the names that are linked to, since a build asks no network.
intersphinx_mapping = {
    "python": ("https://docs.python.org/3/", "inventories/python.inv"),
    "numpy": ("https://numpy.org/doc/stable/", "inventories/numpy.inv"),
    "jax": ("https://docs.jax.dev/en/latest/", "inventories/jax.inv"),
    "diffrax": ("https://docs.kidger.site/diffrax/", "inventories/diffrax.inv"),
    "equinox": ("https://docs.kidger.site/equinox/", "inventories/equinox.inv"),
}

# Site
html_theme = "furo"
html_title = "polhode"
html_baseurl = "https://polhode.github.io/polhode/"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_show_sourcelink = False
html_copy_source = False
html_show_search_summary = False  # summaries are fetched, which a page opened from disk cannot do
html_theme_options = {
    "source_repository": REPOSITORY,
    "source_branch": "main",
    "source_directory": "docs/",
    "top_of_page_buttons": [],
    "footer_icons": [{"name": "GitHub", "url": REPOSITORY, "html": "GitHub", "class": ""}],
}

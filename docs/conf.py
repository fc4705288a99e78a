"""The documentation site: Sphinx makes it of the pages in this folder (``make docs``)."""

import sys
from importlib.metadata import version as version_of
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pygments.lexers.special import TextLexer

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

project = "noack"
author = "the noack authors"
version = release = version_of("noack")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "reference_pages",
]
myst_enable_extensions = ["dollarmath"]

# Sections are linked to by the names that GitHub gives them, so that links work there as well.
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "description"

html_theme = "furo"
html_title = "noack"
# MathJax is served with the site, not from another host. Only the package's files are used: its
# Sphinx extension does not declare itself safe for parallel reading.
_mathjax = find_spec("sphinx-mathjax-offline")
assert _mathjax is not None
assert _mathjax.submodule_search_locations is not None
mathjax_path = "mathjax/tex-chtml.js"
html_static_path = ["_static", str(Path(_mathjax.submodule_search_locations[0]) / "static")]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
# Words of shell sessions and of files are no smart punctuation.
smartquotes = False


def setup(sphinx: Any) -> None:
    """Let the test vectors of the wire format be what they are, words of no language."""
    sphinx.add_lexer("vector", TextLexer)

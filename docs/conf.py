"""How Sphinx makes the pages a site: `make docs`."""

import re
from importlib import metadata

from sphinx.application import Sphinx

project = "servobench"
author = "The servobench maintainers"
project_copyright = "The servobench maintainers, BSD-3-Clause"
try:
    release = metadata.version("servobench")
except metadata.PackageNotFoundError:  # a checkout that is on the path only
    release = "0"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["tables", "page_studies", "examples"]
myst_heading_anchors = 4
highlight_language = "none"  # indented blocks are equations and output
nitpicky = False

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = "servobench"
html_show_sourcelink = False
copybutton_exclude = ".linenos, .gp, .go"

OUTSIDE = re.compile(r"\]\(((?:\.\./)+[^)#\s]+\.md)(?:#[^)\s]*)?\)")  # files beside the code


def setup(app: Sphinx) -> None:
    """Make links to Markdown files outside this folder downloads, as links to code are."""
    app.connect("source-read", link_files)


def link_files(app: Sphinx, name: str, source: list[str]) -> None:
    """Rewrite the links of one page before it is read."""
    outside = (app.srcdir / name).parent

    def as_file(link: re.Match[str]) -> str:
        inside = (outside / link[1]).resolve().is_relative_to(app.srcdir.resolve())
        return link[0] if inside else f"](<path:{link[1]}>)"

    source[0] = OUTSIDE.sub(as_file, source[0])

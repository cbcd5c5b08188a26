"""How Sphinx makes the pages a site: `make docs`.

The site opens without a network. Equations, `$x$` and fences of `math`, become MathML, which browsers set themselves; a
code host sets the same TeX. SVG pictures stand in the page, so that they follow its light and dark theme.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml
from myst_parser.parsers.sphinx_ import MystParser
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

from servobench.harness.config.installation import installed_version

project = "servobench"
author = "The servobench maintainers"
project_copyright = "The servobench maintainers, BSD-3-Clause"
release = installed_version() or "0"  # of a checkout that is on the path only

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["tables", "page_studies", "examples"]
html_static_path = ["site.css"]
html_css_files = ["site.css"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 4
html_math_renderer = "mathml"
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

# Docutils would set the index below the accented letter
ACCENT = re.compile(r"(\\(?:bar|dot|hat|tilde)\{[^{}]*\})_")
# Which a browser would stretch to the height of the row
FENCE = re.compile("<mo[^>]*>([‖⟨⟩|])</mo>")
SHORT = 24  # letters of code that is not broken
OUTSIDE = re.compile(r"\]\(((?:\.\./)+[^)#\s]+\.md)(?:#[^)\s]*)?\)")  # files beside the code


def setup(app: Sphinx) -> None:
    """Make links to Markdown files outside this folder downloads, as those to code are; set equations and drawings."""
    app.connect("source-read", link_files)
    app.connect("doctree-resolved", inline_drawings)
    app.connect("doctree-resolved", keep_together)
    app.add_source_suffix(".ipynb", "notebook")
    app.add_source_parser(NotebookParser)
    app.add_html_math_renderer("mathml", (write_formula, None), (write_formula, None))


def write_formula(writer: HTML5Translator, node: nodes.math | nodes.math_block) -> None:
    """Write an equation as MathML."""
    block = isinstance(node, nodes.math_block)
    mathml = latex2mathml.tex2mathml(ACCENT.sub(r"\1{}_", node.astext()), as_block=block)
    mathml = FENCE.sub(r'<mo stretchy="false">\1</mo>', mathml)
    writer.body.append(f'<div class="formula">{mathml}</div>' if block else mathml)
    raise nodes.SkipNode


class NotebookParser(MystParser):
    """Reads a notebook with its stored outputs as a page."""

    supported = ("notebook",)

    def parse(self, inputstring: str, document: nodes.document) -> None:
        """Read the page that the cells make."""
        cells = json.loads(inputstring)["cells"]
        super().parse("\n\n".join(text for cell in cells for text in cell_texts(cell)), document)


def cell_texts(cell: dict[str, Any]) -> Iterator[str]:
    """Yield the Markdown of a cell and of each of its outputs."""
    source = "".join(cell["source"])
    yield source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```"
    for output in cell.get("outputs", []):
        data = output.get("data", {})
        if "image/png" in data:
            yield f"![{data['text/plain']}](data:image/png;base64,{data['image/png'].strip()})"
        elif "text/html" in data:
            yield f"```{{raw}} html\n{''.join(data['text/html'])}\n```"
        else:
            yield f"```text\n{output['text']}```"


def inline_drawings(app: Sphinx, page: nodes.document, _name: str) -> None:
    """Put SVG drawings into the page in place of links to their files."""
    for image in list(page.findall(nodes.image)):
        if image["uri"].endswith(".svg"):
            drawing = (Path(app.srcdir) / image["uri"]).read_text(encoding="utf-8")
            image.replace_self(
                nodes.raw("", f'<div class="drawing">{drawing}</div>', format="html")
            )


def keep_together(_app: Sphinx, page: nodes.document, _name: str) -> None:
    """Keep options and other short code on one line, and each number of a table on that of its percent sign."""
    for code in page.findall(nodes.literal):
        code["classes"] += ["short"] if len(code.astext()) <= SHORT else []
    for text in [text for cell in page.findall(nodes.entry) for text in cell.findall(nodes.Text)]:
        text.parent.replace(text, nodes.Text(text.replace(" %", "\u00a0%")))


def link_files(app: Sphinx, name: str, source: list[str]) -> None:
    """Rewrite the links of one page before it is read."""
    outside = (app.srcdir / name).parent

    def as_file(link: re.Match[str]) -> str:
        inside = (outside / link[1]).resolve().is_relative_to(app.srcdir.resolve())
        return link[0] if inside else f"](<path:{link[1]}>)"

    source[0] = OUTSIDE.sub(as_file, source[0])

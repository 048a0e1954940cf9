"""The documentation site: `sphinx-build -W --keep-going -c docs . build/site` in the root of the repository.

The root is the source folder, so that links between the README, `docs/` and the experiments lead to the same
files here and on GitHub.
"""

import re
from importlib import metadata

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

project = "jaxpanda"
author = copyright = "The jaxpanda team"
version = release = metadata.version("jaxpanda")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**", "kernels/README.md", "experiments/*/README.md"]
exclude_patterns = [".*", "build", "dist", "**/__pycache__"]

html_theme = "furo"
html_math_renderer = "mathml"
html_title = "jaxpanda"
html_static_path, html_css_files = ["static"], ["site.css"]
html_extra_path = ["llms.txt", "schemas"]
html_copy_source = html_show_sourcelink = False
html_additional_pages = {"index": "to_start.html"}
templates_path = ["templates"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 240
nb_execution_in_temp = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_google_docstring, napoleon_numpy_docstring = True, False
autodoc_inherit_docstrings = False
autodoc_preserve_defaults = True
suppress_warnings = ["ref.python"]  # names that several classes share, in prose


_COLON = "\ue000"


def _from_markdown(app, what, name, obj, options, lines):
    """Docstrings have Markdown's `code` and $mathematics$; autodoc reads reStructuredText."""
    text = "\n".join(lines)
    text = re.sub(r"\$\$(.+?)\$\$", _block, text, flags=re.DOTALL)
    text = re.sub(r"(?<![`:\w])`([^`\n]+)`(?!`)", r"``\1``", text)
    text = re.sub(r"(?<![\$\\])\$([^\$\n]+)\$", r":math:`\1`", text)
    text = re.sub(r"^\+ ", r"\+ ", text)
    lines[:] = text.replace(_COLON, ":").split("\n")


def _block(found: re.Match[str]) -> str:
    inside = " ".join(line.strip() for line in found[1].strip().split("\n"))
    return f"\n.. math:: {inside}\n"


def _without_type(app, what, name, obj, options, lines):
    """Napoleon takes what stands before an attribute's colon for a type; ours are in annotations."""
    if what in ("attribute", "property", "data"):
        lines[:1] = [line.replace(":", _COLON) for line in lines[:1]]


def _short(app, what, name, obj, options, signature, returns):
    return signature and re.sub(r"~(?:\w+\.)+", "", signature), returns


def _inline_mathml(self, node):
    self.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _block_mathml(self, node):
    self.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app):
    app.connect("autodoc-process-docstring", _without_type, priority=400)
    app.connect("autodoc-process-docstring", _from_markdown, priority=900)
    app.connect("autodoc-process-signature", _short)
    # equations that browsers draw by themselves: MathJax would come from another server
    app.add_html_math_renderer("mathml", (_inline_mathml, None), (_block_mathml, None))

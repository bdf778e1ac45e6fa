"""Sphinx configuration: pages from the README, this folder and the docstrings (make docs)."""

from __future__ import annotations

import contextlib
import io
import os
import re
from pathlib import Path
from typing import Any

import svu_mi  # first: it finds a usable LLVM
import mitsuba as mi
from docutils import nodes
from docutils.parsers.rst.directives.tables import ListTable
from sphinx.application import Sphinx
from sphinx.directives.code import CodeBlock
from sphinx.ext.napoleon import Config, GoogleDocstring
from sphinx.util.docutils import SphinxDirective

from svu_mi.cli.main import COMMANDS, main

mi.set_variant("llvm_ad_rgb")  # classes of plugins exist only in a variant
os.environ["COLUMNS"] = "100"  # width of the help texts

project, version = "svu_mi", svu_mi.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.doctest", "sphinx.ext.viewcode"]
root_doc = "README"
include_patterns = ["*.md", *(f"notebooks/{kind}" for kind in ("*.md", "*.rst", "*.ipynb")),
                    "notebooks/benchmarks/*.md", "notebooks/design/*.md"]  # fmt: skip
exclude_patterns = [".*", "build", "dist", "out", "scenes", "svu_mi", "tests"]
nb_execution_mode = "off"  # notebooks are stored executed
myst_heading_anchors = 4
SANS = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', sans-serif"
html_theme_options = {  # narrower windows than page_width have no navigation
    "page_width": "1160px", "body_max_width": "none", "sidebar_width": "250px",
    "font_family": SANS, "head_font_family": SANS, "font_size": "16px",
}  # fmt: skip
html_static_path = ["custom.css"]  # loaded by the theme
toc_object_entries_show_parents = "hide"
html_show_copyright = html_show_sphinx = False
maximum_signature_line_length = 80

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
GOOGLE = Config(napoleon_use_ivar=True)

# Examples of the reference run in a temporary folder with a small capture of the vase.
doctest_global_setup = """
import contextlib, io, os, tempfile
import svu_mi as svu
import mitsuba as mi
import numpy as np
from svu_mi.cli.main import main

folder = tempfile.TemporaryDirectory()
os.chdir(folder.name)
size = ["--views", "12", "--resolution", "96", "--spp", "16"]
with contextlib.redirect_stdout(io.StringIO()):
    main(["scenes", "vase"])
    main(["render", "scenes/vase/vase.xml", *size, "-D", "light=window", "-o", "capture"])
"""
doctest_global_cleanup = "os.chdir('/')"

# Substitutions that docstrings of plugins use, as in Mitsuba's manual.
TYPES = re.compile(r"\|(bool|exposed|false|float|int|rgb|string|texture|true)\|")
MANUAL = "https://mitsuba.readthedocs.io/en/stable/src/generated/plugins_{}s.html#{}"

CONTENTS = """
```{toctree}
:hidden:
:caption: Pages
notebooks/phone
notebooks/tools
notebooks/capture
notebooks/methods
notebooks/how
notebooks/guiding
notebooks/recovering
notebooks/own_loop
notebooks/results
notebooks/many
notebooks/cluster
notebooks/limits
notebooks/promises
notebooks/troubleshooting
notebooks/glossary
notebooks/paper
BENCHMARKS
```
```{toctree}
:hidden:
:caption: Benchmarks
STUDIES
```
```{toctree}
:hidden:
:caption: Notebooks
notebooks/entropy
notebooks/guidance
notebooks/recovery
notebooks/uncertainty
notebooks/import
notebooks/light
notebooks/conventions
```
```{toctree}
:hidden:
:caption: Reference
notebooks/python
notebooks/commands
notebooks/plugins
CONTRIBUTING
CHANGELOG
SECURITY
```
```{toctree}
:hidden:
:caption: Reasons of defaults
DESIGN
```
"""


class PluginParameters(ListTable):
    """Table of a plugin's parameters: name, type, meaning."""


class Tabs(SphinxDirective):
    """Tabs, rendered one below the other."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        return self.parse_content_to_nodes()


def in_mitsubas_manual(app: Sphinx, env: Any, node: Any, text: nodes.Node) -> nodes.Node | None:
    """Resolve references to plugins of Mitsuba, such as ``bsdf-principled``."""
    kind = node["reftarget"].partition("-")[0]
    if kind not in ("bsdf", "integrator"):
        return None
    return nodes.reference("", "", text, refuri=MANUAL.format(kind, node["reftarget"]))


def help_of(command: str) -> str:
    """Return the output of ``svu COMMAND --help``."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([command, "--help"])
    return text.getvalue()


def pages_of(folder: str) -> str:
    """Return the pages of a folder of ``notebooks``, a line each."""
    paths = sorted((Path(__file__).parent / folder).glob("*.md"))
    return "\n".join(f"notebooks/{folder}/{path.stem}" for path in paths)


def complete(app: Sphinx, page: str, source: list[str]) -> None:
    """Add the table of contents to the README, and help texts to the page of commands."""
    if page == root_doc:
        source[0] += CONTENTS.replace("STUDIES", pages_of("benchmarks")).replace(
            "DESIGN", pages_of("design"))  # fmt: skip
    if page == "notebooks/commands":
        source[0] += "".join(f"\n## svu {n}\n\n```text\n{help_of(n)}```\n" for n in COMMANDS)


def read_docstring(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Convert a Google-style docstring to reST; indented formulas become literal blocks."""
    text, last = [], ""
    for before, line in zip(["", *lines], lines, strict=False):
        if line.startswith(" ") and not before and last and not last.startswith((" ", "*", "..")):
            text += ["::", ""]
        text.append(TYPES.sub(r"``\1``", line))
        last = line or last
    # As an attribute, text before a colon on the first line would be read as its type.
    kind = "method" if what in ("attribute", "property") else what
    lines[:] = GoogleDocstring(text, GOOGLE, app, kind, name, thing, options).lines()


def without_factories(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, signature: str, returned: str
) -> tuple[str, str] | None:
    """Replace default factories of dataclasses, which Sphinx cannot parse."""
    return (signature.replace("<factory>", "..."), returned) if signature else None


def setup(app: Sphinx) -> None:
    """Register directives, roles and event handlers."""
    app.add_directive("pluginparameters", PluginParameters)
    app.add_directive("tabs", Tabs)
    app.add_directive("code-tab", CodeBlock)
    app.add_generic_role("monosp", nodes.literal)
    app.add_generic_role("math", nodes.emphasis, override=True)  # MathJax needs a network
    app.connect("missing-reference", in_mitsubas_manual)
    app.connect("source-read", complete)
    # Both pages change without their files: a page is added, or the help of a command changes.
    app.connect("env-get-outdated", lambda *_: [root_doc, "notebooks/commands"])
    app.connect("autodoc-process-docstring", read_docstring)
    app.connect("autodoc-process-signature", without_factories)

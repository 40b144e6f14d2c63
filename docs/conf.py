"""Sphinx's configuration. `make docs` builds the pages of this folder with every warning as an error.

The generator is Sphinx with MyST, which reads Markdown. MkDocs has had no release since 2024, and its Material theme is
maintained until May 2027 only. Nothing is loaded from another server: the theme brings its scripts and uses the
reader's fonts.
"""

import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from docs.generate import write_pages  # noqa: E402

from docs import docstrings  # noqa: E402  # the path comes first
from splatmill import __version__  # noqa: E402

project = "Splatmill"
release = version = __version__
copyright = "the Splatmill authors"

extensions = ["myst_parser", "sphinx.ext.autodoc"]
# The last two are parts of pages.
exclude_patterns = ["build", "generate", "generated/python-errors.md", "generated/formats.md"]

nitpicky = True
nitpick_ignore_regex = [("py:.*", r".*")]  # types in signatures; links in the text are checked all the same

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_type_aliases = {
    name: name for name in ("AnyPath", "Emit", "Float", "OnBytes", "OnProgress", "Revise", "Tensor")
}

smartquotes = False  # they would turn the two hyphens of an option into a dash

html_theme = "furo"
html_title = "Splatmill"
html_show_sphinx = False
html_copy_source = False


def setup(app: Any) -> None:
    """Generate the pages before Sphinx looks for its sources; with `-t expected`, ask the program for no answers."""
    write_pages(HERE / "generated", ask="expected" not in app.tags)
    app.connect("autodoc-process-docstring", docstrings.as_restructured_text)

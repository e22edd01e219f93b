"""The manual: `sphinx-build -W docs out/manual`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import gathered

project = "benchsim"
author = "The benchsim maintainers"
extensions = ["myst_nb", "sphinx.ext.autodoc", "numpydoc"]
html_theme = "furo"
html_title = "benchsim"
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "force"
nb_execution_timeout = 1800
nb_execution_raise_on_error = True
nb_merge_streams = True
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
autodoc_member_order = "bysource"
suppress_warnings = ["myst.header", "myst-nb.lexer"]


def gather(app, config):
    """Pages that are made; those who do not run the tutorials do without pictures that take time too."""
    gathered.write(Path(__file__).parent / "gathered", pictures=config.nb_execution_mode != "off")


def relinked(app, docname, source):
    """Links of pages that are read in the repository too, as the manual has them."""
    if not docname.startswith("gathered/"):
        source[0] = gathered.relinked(source[0], (Path(__file__).parent / docname).parent, docname)


def setup(app):
    app.connect("config-inited", gather)
    app.connect("source-read", relinked)

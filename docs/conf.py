"""Configuration of Sphinx: `make docs` writes the site to build/docs."""

import sys
from pathlib import Path

import eomc

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "site"))

project = "eomc"
author = "the eomc authors"
copyright = "the eomc authors"
version = release = eomc.__version__

# `site` is the folder of our own extension: links, scene keys, gallery, C functions, formulas
extensions = ["myst_nb", "sphinx.ext.autodoc", "numpydoc", "sphinx_click", "eomc_site"]
root_doc = "README"
exclude_patterns = ["examples", "site", "reference/*.toml"]
nb_execution_mode = "force"  # notebooks are stored without outputs
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300
myst_heading_anchors = 4  # the anchors that code-hosting sites give to headings
myst_enable_extensions = ["dollarmath"]
smartquotes = False  # dashes of options stay as they are typed
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # numpydoc's sections have the types
numpydoc_show_class_members = False

html_theme = "pydata_sphinx_theme"
html_title = "eomc"
html_math_renderer = "mathml"  # formulas are shown without a script from elsewhere
html_static_path = ["site/static"]
html_show_sourcelink = False
html_sidebars = {"README": []}
html_theme_options = {
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "footer_start": ["copyright"],
    "footer_end": [],
    "secondary_sidebar_items": ["page-toc"],
}

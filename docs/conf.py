"""Sphinx configuration of unjam's documentation."""

import os
import sys
from pathlib import Path

import unjam

here = Path(__file__).parent
sys.path.insert(0, str(here))  # the pages import tables.py
os.environ["PYTHONPATH"] = os.pathsep.join([str(here), *filter(None, [os.environ.get("PYTHONPATH")])])

import cells  # noqa: E402

project = "unjam"
author = copyright = "The unjam maintainers"
release = version = unjam.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
html_theme = "furo"
html_title = "unjam"
html_static_path = ["_static"]
html_css_files = ["pictures.css"]

nb_execution_mode = "cache"
nb_execution_cache_path = str(cells.cache_folder(here / "_build" / "cells"))
nb_execution_in_temp = True
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True
myst_heading_anchors = 3

autoclass_content = "both"
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_default_options = {"members": True, "show-inheritance": True}
suppress_warnings = ["mystnb.unknown_mime_type"]

"""Sphinx configuration. `make docs` builds with warnings as errors."""

import sys
from pathlib import Path

import gapcert

sys.path.insert(0, str(Path(__file__).parent))

project = "Gapcert"
author = "the Gapcert authors"
release = version = gapcert.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "generate", "survived"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "benchmarks"]
html_math_renderer = "mathml"
smartquotes = False  # what is quoted are names and messages, which readers copy and search for
html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["tables.css"]
html_show_copyright = False
html_title = f"Gapcert {release}"
autodoc_member_order = "bysource"
autodoc_type_aliases = {name: name for name in ("Array", "Emit", "FitRoute", "Policy", "Sampling")}
autodoc_typehints_format = "short"
suppress_warnings = ["config.cache"]
# For `sphinx -b linkcheck`, where there is a network; what leads to pages, pictures and files of the repository is a test.
linkcheck_timeout = 20
linkcheck_retries = 2
linkcheck_workers = 4
linkcheck_anchors = False
linkcheck_ignore = [r"^(\.\./)+", r"^file:"]  # files of the repository, which tests look for

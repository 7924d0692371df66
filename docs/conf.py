# SPDX-License-Identifier: Apache-2.0
"""The documentation as a site: ``make docs`` writes docs/_build/html (Sphinx, MyST, numpydoc)."""

project = "smp_motor_control"
author = "smp_motor_control maintainers"
extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc"]
exclude_patterns = ["_build"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = project
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_show_copyright = False
autodoc_member_order = "bysource"
numpydoc_show_class_members = False

"""The documentation as a site: ``make docs`` writes docs/_build/html (Sphinx, MyST, numpydoc)."""

project = "smp_motor_control"
author = "smp_motor_control maintainers"
extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc"]
root_doc = "README"
exclude_patterns = ["_build"]
myst_heading_anchors = 3
html_theme = "alabaster"
html_theme_options = {"description": "From a recorded bag to wheels that do what cmd_vel asks."}
html_show_sourcelink = False
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
suppress_warnings = ["myst.xref_missing"]  # links to files of the repository beside docs/

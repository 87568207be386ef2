"""The documents as a site; `scripts/check` builds it into build/docs and fails on every warning."""

project = "GrainGS"
extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3  # links to headings are checked down to this level
nitpicky = True
html_theme = "furo"
html_title = "GrainGS"
html_copy_source = False

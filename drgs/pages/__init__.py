"""HTML pages of one file: the report of a fit, and a scene that is shared."""

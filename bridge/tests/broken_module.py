"""A module that does not import, and not with an ImportError."""

raise RuntimeError("two\nlines")

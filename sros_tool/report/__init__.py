"""Pictures of who may do what: from rights to values, and from values to SVG, DOT, a page."""

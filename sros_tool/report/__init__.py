"""Pictures of the rights of enclaves, as SVG, DOT, Mermaid, JSON, or an HTML page."""

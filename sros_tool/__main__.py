"""``python -m sros_tool`` is ``sros``."""

from sros_tool.cli import main

main()

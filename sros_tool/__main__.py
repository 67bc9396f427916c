"""Entry point of ``python -m sros_tool``, which is the same as ``sros``."""

from sros_tool.cli import main

main()

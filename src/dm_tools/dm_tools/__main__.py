"""python -m dm_tools."""

from dm_tools.cli import main

main()

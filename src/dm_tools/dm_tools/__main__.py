"""python -m dm_tools.cli."""

from dm_tools.cli import main

main()

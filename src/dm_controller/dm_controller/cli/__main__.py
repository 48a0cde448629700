"""python -m dm_controller.cli."""

from dm_controller.cli import main

main()

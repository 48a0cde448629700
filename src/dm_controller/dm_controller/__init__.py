"""Open-loop focus controller for deformable mirrors, with launch files and the dm command."""

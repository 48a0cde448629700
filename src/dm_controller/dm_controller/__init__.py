"""Open-loop focus control of deformable mirrors, and the closed loop on an interferometer."""

"""The influence function of a deformable mirror: what is commanded, what is measured, and the linear model between."""

"""The influence function of a deformable mirror: the linear model from commands to measured maps, and its fit."""

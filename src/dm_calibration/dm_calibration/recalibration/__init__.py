"""Updates of a calibration by later maps: gains and figure by recursive least squares."""

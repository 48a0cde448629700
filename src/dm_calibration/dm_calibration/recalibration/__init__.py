"""Later maps keep a calibration true: gains and figure by recursive least squares."""

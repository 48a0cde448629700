"""The calibration procedure: plan, run, checks of each map, journal and resumption."""

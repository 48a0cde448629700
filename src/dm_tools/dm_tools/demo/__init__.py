"""The demo: a simulated bench is calibrated, focused and measured."""

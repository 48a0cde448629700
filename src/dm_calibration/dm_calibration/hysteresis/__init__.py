"""Hysteresis and creep of piezo actuators, identified from maps and followed through commands."""

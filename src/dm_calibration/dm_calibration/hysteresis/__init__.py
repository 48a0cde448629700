"""What piezo actuators remember: hysteresis and creep, identified from maps and followed through commands."""

"""What more than one node of the suite needs: executor and parameters, optics, hysteresis model, limits, messages."""

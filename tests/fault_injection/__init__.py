"""Fault injection: damaged files for every reader, and faults of wires, processes and commands around real nodes."""

"""Shared by all nodes of the suite: the executor, worker threads, parameters, QoS profiles and diagnostics."""

#: Environment variable: process id of the parent that a node ends with, since a killed parent cannot stop its nodes.
SUPERVISOR = "DM_SUPERVISOR"

"""Benchmarks of running nodes: latencies between processes and hosts, and the cost of idle nodes."""

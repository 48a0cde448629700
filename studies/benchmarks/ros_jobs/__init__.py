"""Benchmarks of running nodes: latencies between processes and hosts, and what idle nodes cost."""

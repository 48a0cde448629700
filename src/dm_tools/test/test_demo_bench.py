"""Ports of a virtual bench."""

from dm_tools.demo.demo_bench import free_ports


def test_ports_that_nobody_has_bound_yet_are_not_handed_out_again() -> None:
    drawn = [port for _ in range(50) for port in free_ports(4)]
    assert len(set(drawn)) == len(drawn)

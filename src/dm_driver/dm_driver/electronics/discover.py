"""List the EDAC40 units on the network: `python -m dm_driver.electronics.discover [--address A] [--port P]`."""

import argparse
import sys
from collections.abc import Sequence

from dm_driver.electronics import discovery


def main(arguments: Sequence[str] | None = None) -> int:
    """Print one line per unit. Returns 0 when at least one answered."""
    parser = argparse.ArgumentParser(prog="python -m dm_driver.electronics.discover", description=__doc__)
    parser.add_argument("--address", default=discovery.BROADCAST, help="host or broadcast address (%(default)s)")
    parser.add_argument("--port", type=int, default=discovery.PORT, help="UDP port (%(default)s)")
    parser.add_argument("--timeout", type=float, default=1.0, help="time to wait for answers in s (%(default)s)")
    options = parser.parse_args(arguments)
    try:
        units = discovery.discover(options.address, options.port, options.timeout)
    except (OSError, OverflowError) as error:
        print(f"discovery failed at {options.address}:{options.port}: {error}", file=sys.stderr)
        return 1
    for unit in units:
        print(f"{unit.name}  {unit.mac}  {unit.address}")
    if not units:
        print(f"no EDAC40 answered at {options.address}:{options.port}", file=sys.stderr)
    return 0 if units else 1


if __name__ == "__main__":
    sys.exit(main())

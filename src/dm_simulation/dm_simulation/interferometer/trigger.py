#!/usr/bin/env python3
"""Ask the virtual bench for one measurement: prints the path of the map file, exit status 0; else 1 and the reason.

Standard library only and runnable on its own, so that it starts as fast as an instrument's own trigger program:
`python -S -I trigger.py --port N [--output PATH]`.
"""

import socket
import sys

USAGE = "usage: trigger.py --port N [--output PATH] [--timeout SECONDS]"


def measure(port: int, output: str = "", timeout: float = 30.0) -> str:
    """Return the path of the new map file.

    Raises:
        OSError: no bench on that port, no answer in time, or the bench's own reason.
    """
    with socket.create_connection(("127.0.0.1", port), timeout=timeout) as connection:
        connection.sendall(f"MEASURE {output}\n".encode())
        answer = b""
        while not answer.endswith(b"\n"):
            received = connection.recv(4096)
            if not received:
                raise OSError("the bench closed the connection without an answer")
            answer += received
    status, _, text = answer.decode(errors="replace").strip().partition(" ")
    if status != "OK":
        raise OSError(text or "no reason given")
    return text


def main(arguments: "list[str]") -> int:
    options = {"--port": "", "--output": "", "--timeout": "30"}
    if arguments in (["-h"], ["--help"]):
        print(__doc__.strip(), USAGE, sep="\n\n")
        return 0
    if len(arguments) % 2 or any(name not in options for name in arguments[::2]):
        print(USAGE, file=sys.stderr)
        return 1
    options.update(zip(arguments[::2], arguments[1::2]))  # noqa: B905  (also for older interpreters)
    try:
        print(measure(int(options["--port"]), options["--output"], float(options["--timeout"])))
    except (OSError, ValueError) as error:
        print(f"trigger: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

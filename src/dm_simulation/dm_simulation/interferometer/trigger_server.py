r"""The bench's side of the trigger: one line of text in, one out, over a loopback TCP port.

`MEASURE <absolute path, or nothing>\\n` is answered by `OK <path>\\n` or `ERROR <words>\\n`.
"""

import socketserver
import threading
from collections.abc import Callable
from pathlib import Path

from dm_simulation.electronics.server import LOOPBACK, PortError


class TriggerServer:
    """Answers requests by calling `measure(path or None) -> path`, which may raise ValueError or OSError."""

    def __init__(self, port: int, measure: Callable[[Path | None], Path]) -> None:
        class Handler(socketserver.StreamRequestHandler):
            timeout = 10.0

            def handle(self) -> None:
                try:
                    line = self.rfile.readline(8192).decode().rstrip("\r\n")
                    word, _, argument = line.partition(" ")
                    if word != "MEASURE":
                        raise ValueError(f"unknown request {word!r}, only MEASURE is known")
                    answer = f"OK {measure(Path(argument) if argument else None)}"
                except (ValueError, OSError) as error:
                    answer = f"ERROR {' '.join(str(error).split())}"
                try:
                    self.wfile.write(answer.encode() + b"\n")
                except OSError:
                    pass  # the client did not wait for the answer

        class Server(socketserver.ThreadingTCPServer):
            allow_reuse_address = True
            daemon_threads = True

        try:
            self._server = Server((LOOPBACK, port), Handler)
        except OSError as error:
            raise PortError("trigger.port", port, error) from None
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, name="trigger", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop answering."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5)

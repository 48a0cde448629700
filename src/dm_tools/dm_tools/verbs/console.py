"""`dm console`: the bench console, a web page on loopback."""

import socket
from typing import Annotated

import typer

from dm_tools.console import HOST
from dm_tools.output import NamespaceOption
from dm_tools.output import console as terminal

DEFAULT_PORT = 8037


def console(
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = DEFAULT_PORT,
    namespace: NamespaceOption = "",
) -> None:
    """Serve the bench console: see the mirror, calibrate it and focus it from a browser on this machine.

    Talks to the running nodes (`dm up`) through ROS only, and to browsers on this machine only. Ctrl-C ends it; the
    mirror keeps its shape.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise RuntimeError(f"--port {port}: {error.strerror}; name another, 1 to 65535") from error

    from dm_tools.console.console_node import ConsoleNode

    try:
        from dm_tools.console.page import serve
    except ModuleNotFoundError as error:
        if error.name != "nicegui":
            raise
        raise RuntimeError("the console needs NiceGUI: `pip install nicegui`, see docs/install.md") from error
    ros = ConsoleNode(namespace)
    try:
        terminal.print(f"console: http://{HOST}:{port}   (Ctrl-C ends it)")
        serve(ros, port)
    finally:
        ros.close()

"""The server of the page, which answers its own page alone.

Browsers let every page open a websocket to this machine, and send its address as `Origin`. viser asks for none, so the
library beneath it is told which to accept. Programs send no origin, and may come.
"""

import socket
from functools import partial
from ipaddress import IPv4Address
from unittest.mock import patch

import rich
import viser
from websockets.asyncio import server as library
from websockets.typing import Origin

from servobench.plant.contract.faults import configuration_errors


def open_server(host: str, port: int) -> viser.ViserServer:
    """Return a server at an address of this machine.

    The port is tried first, as viser takes the next one in place of one that is used.

    Raises:
        ConfigurationError: no such address, or a port that is used.
    """
    with configuration_errors("--host: "):
        IPv4Address(host)
    with configuration_errors(
        f"{host}:{port} cannot be opened, try another --port: ", OSError, OverflowError
    ):
        socket.create_server((host, port)).close()
    rich.get_console().quiet = True  # on which viser prints
    origins = [None, Origin(f"http://{host}:{port}"), Origin(f"http://localhost:{port}")]
    with patch.object(library, "serve", partial(library.serve, origins=origins)):
        return viser.ViserServer(host, port, verbose=False)

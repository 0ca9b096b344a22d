"""The server of `zlocus inspect`, which runs until it is interrupted."""

from __future__ import annotations

import ipaddress
import os
import signal
import socket
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import uvicorn

from zlocus.core.errors import ConfigError, OutputError
from zlocus.evaluation.comparison import Comparison
from zlocus.inspector.guard import new_token
from zlocus.inspector.inspection import Inspection
from zlocus.inspector.server import application

# Time that requests in progress get to finish.
GRACE_S = 2
HTTP_PORT = 80
Announce = Callable[[str, bool], None]


def inspect_surface(
    out: Path, comparison: Comparison | None, may_read_remote: bool, host: str, port: int, view: str, announce: Announce
) -> None:
    """Serve the page of a surface until interrupted.

    may_read_remote : whether images that run.json names on a server may be read; host, port : address; port 0: any free
    port; view : link of the view to start with, or its part after the #; announce : called with the address, and with
    whether other machines can reach it.

    Raises
    ------
    InputError, ConfigError
        There is no surface in the folder, or the address cannot be used.
    OutputError
        The port is taken.
    """
    address = checked_address(host)
    fragment = fragment_of(view)
    with listening(address, port) as listener, Inspection(out, comparison, may_read_remote) as inspection:
        port, token = listener.getsockname()[1], new_token()
        names = [f"[{address}]" if address.version == 6 else str(address)]
        hosts = names + (["localhost"] if address.is_loopback else [])
        # Browsers leave out the default port.
        known = {f"{host}:{port}" for host in hosts} | (set(hosts) if port == HTTP_PORT else set())
        app = application(inspection, token, frozenset(known))
        config = uvicorn.Config(
            app, log_level="error", access_log=False, server_header=False, ws="none",
            timeout_graceful_shutdown=GRACE_S,
        )  # fmt: skip
        link = f"http://{names[0]}:{port}/{token}/{fragment}"
        _Server(config, lambda: announce(link, not address.is_loopback)).run(sockets=[listener])


class _Server(uvicorn.Server):
    """A server that announces when it is ready, and that SIGHUP ends like SIGTERM: after the requests in progress."""

    def __init__(self, config: uvicorn.Config, announce: Callable[[], None]) -> None:
        super().__init__(config)
        self._announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and announce it."""
        await super().startup(sockets)
        self._announce()

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Handle signals inside the block by ending the server; restore the handlers afterwards."""
        with super().capture_signals():
            hang_up = getattr(signal, "SIGHUP", None)
            before = None if hang_up is None else signal.getsignal(hang_up)
            if hang_up is None or before in (None, signal.SIG_IGN):  # as under nohup
                yield
                return
            signal.signal(hang_up, self.handle_exit)
            try:
                yield
            finally:
                signal.signal(hang_up, before)


def checked_address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Address of this machine that a browser can open.

    Raises
    ------
    ConfigError
        It is a name, or stands for several addresses.
    """
    try:
        address = ipaddress.ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError as error:
        raise ConfigError(f"--host {host} is no address. Give one of this machine, such as 127.0.0.1.") from error
    if address.is_unspecified or address.is_multicast:
        raise ConfigError(f"--host {host} is no single address. Give the one at which the page is opened.")
    return address


def fragment_of(view: str) -> str:
    """The # of a link and the part after it; "" where there is none."""
    text = view.partition("#")[2] if "#" in view else view
    # Characters that addresses do not allow are escaped, since a terminal might interpret them.
    text = "".join(c if "!" <= c <= "~" else "".join(f"%{byte:02X}" for byte in c.encode()) for c in text)
    return f"#{text}" if text else ""


def listening(address: ipaddress.IPv4Address | ipaddress.IPv6Address, port: int) -> socket.socket:
    """A listening socket.

    Raises
    ------
    OutputError
        The address is not this machine's, or the port is taken.
    """
    family = socket.AF_INET6 if address.version == 6 else socket.AF_INET
    # The protocol is named, because only then does asyncio set TCP_NODELAY; without it each answer takes 40 ms more.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        if os.name != "nt":  # There it would let two processes share a port.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((str(address), port))
        listener.listen()
    except OSError as error:
        listener.close()
        raise OutputError(
            f"No page can be served at {address} port {port}: {error.strerror}. Choose another --port, or none."
        ) from error
    return listener

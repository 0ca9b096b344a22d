"""`zlocus inspect`, from the folder to a page that answers until it is interrupted."""

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
from zlocus.inspector.guard import new_token
from zlocus.inspector.inspection import Inspection
from zlocus.inspector.server import application
from zlocus.evaluation.comparison import Comparison

# Answers under way are waited for so long.
GRACE_S = 2
USUAL_PORT = 80
Announce = Callable[[str, bool], None]


def inspect_surface(
    out: Path, comparison: Comparison | None, may_ask: bool, host: str, port: int, view: str, announce: Announce
) -> None:
    """Serve the page of a surface until interrupted.

    may_ask : whether images that run.json names on a server are asked for; host, port : where; port 0 is any that is
    free; view : link of a view, or what stands behind its #, to begin with; announce : is given the address, and
    whether others than this machine can reach it.

    Raises
    ------
    InputError, ConfigError
        There is no surface in the folder, or the address cannot be used.
    OutputError
        The port is taken.
    """
    address = checked_address(host)
    fragment = fragment_of(view)
    with listening(address, port) as listener, Inspection(out, comparison, may_ask) as inspection:
        port, token = listener.getsockname()[1], new_token()
        names = [f"[{address}]" if address.version == 6 else str(address)]
        hosts = names + (["localhost"] if address.is_loopback else [])
        # A browser leaves out the port that is usual.
        known = {f"{host}:{port}" for host in hosts} | (set(hosts) if port == USUAL_PORT else set())
        app = application(inspection, token, frozenset(known))
        config = uvicorn.Config(
            app, log_level="error", access_log=False, server_header=False, ws="none",
            timeout_graceful_shutdown=GRACE_S,
        )  # fmt: skip
        link = f"http://{names[0]}:{port}/{token}/{fragment}"
        _Server(config, lambda: announce(link, not address.is_loopback)).run(sockets=[listener])


class _Server(uvicorn.Server):
    """A server that says when it answers, and that SIGHUP ends as SIGTERM does: after the answers under way."""

    def __init__(self, config: uvicorn.Config, announce: Callable[[], None]) -> None:
        super().__init__(config)
        self._announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to answer, and say so."""
        await super().startup(sockets)
        self._announce()

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Note the signals that come in the block, which ends the server; at its end they do what they did before."""
        with super().capture_signals():
            hang_up = getattr(signal, "SIGHUP", None)
            before = None if hang_up is None else signal.getsignal(hang_up)
            if hang_up is None or before in (None, signal.SIG_IGN):  # as below nohup
                yield
                return
            signal.signal(hang_up, self.handle_exit)
            try:
                yield
            finally:
                signal.signal(hang_up, before)


def checked_address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """An address of this machine that a browser can be given.

    Raises
    ------
    ConfigError
        It is a name, or stands for all addresses.
    """
    try:
        address = ipaddress.ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError as error:
        raise ConfigError(f"--host {host} is no address. Give one of this machine, such as 127.0.0.1.") from error
    if address.is_unspecified or address.is_multicast:
        raise ConfigError(f"--host {host} stands for no single address. Give that under which the page is asked for.")
    return address


def fragment_of(view: str) -> str:
    """What stands behind the # of a link, with it; "" of nothing."""
    text = view.partition("#")[2] if "#" in view else view
    # What no address holds, as a terminal would otherwise take it for its own.
    text = "".join(c if "!" <= c <= "~" else "".join(f"%{byte:02X}" for byte in c.encode()) for c in text)
    return f"#{text}" if text else ""


def listening(address: ipaddress.IPv4Address | ipaddress.IPv6Address, port: int) -> socket.socket:
    """A socket that listens.

    Raises
    ------
    OutputError
        The address is not this machine's, or the port is taken.
    """
    family = socket.AF_INET6 if address.version == 6 else socket.AF_INET
    # Named as TCP, for only then does asyncio send answers without waiting (TCP_NODELAY): else each takes 40 ms more.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        if os.name != "nt":  # where it would let two processes share a port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((str(address), port))
        listener.listen()
    except OSError as error:
        listener.close()
        raise OutputError(
            f"No page can be served at {address} port {port}: {error.strerror}. Choose another --port, or none."
        ) from error
    return listener

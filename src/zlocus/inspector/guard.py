"""Access control of the page: requests need the token, the page's own address, and a method that only reads."""

from __future__ import annotations

import base64
import hashlib
import re
import secrets
from typing import Any

from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

TOKEN_BYTES = 24
# Allowed scripts are the page's own files and the import map inside the page.
POLICY = (
    "default-src 'none'; script-src 'self' {hashes}; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin", "Cross-Origin-Opener-Policy": "same-origin",
}  # fmt: skip
WORDS = {
    403: "Not allowed. Open the address that `zlocus inspect` printed when it started.",
    404: "There is nothing here.",
    405: "Nothing can be changed here.",
}


def new_token() -> str:
    """A token that cannot be guessed."""
    return secrets.token_urlsafe(TOKEN_BYTES)


class Guard:
    """Application that lets through requests of this page: with its token, host and origin, and only to read.

    hosts : "host:port" as the browser may write them.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: frozenset[str], policy: str) -> None:
        self.app, self.token, self.hosts = app, token, hosts
        self.headers = {**HEADERS, "Content-Security-Policy": policy}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # Other kinds of connection are never accepted.
        refusal = self._refusal(Request(scope))
        if refusal is not None:
            await refusal(scope, receive, send)
            return

        async def send_guarded(message: Any) -> None:
            if message["type"] == "http.response.start":
                extra = [(name.lower().encode(), value.encode()) for name, value in self.headers.items()]
                message = {**message, "headers": [*message["headers"], *extra]}
            await send(message)

        # The routes see only the part of the path after the token.
        await self.app({**scope, "path": scope["path"][len(self.token) + 1 :]}, receive, send_guarded)

    def _refusal(self, request: Request) -> Response | None:
        """The answer to a request that is refused; None for one that is let through."""
        origin, path = request.headers.get("origin"), request.scope["path"]
        is_own = request.headers.get("host", "") in self.hosts
        is_own &= origin is None or origin in {f"http://{host}" for host in self.hosts}
        given = path.encode("utf-8", "replace")
        if is_own and secrets.compare_digest(given, f"/{self.token}".encode()):
            return RedirectResponse(f"/{self.token}/", headers=self.headers)
        if not is_own or not secrets.compare_digest(given[: len(self.token) + 2], f"/{self.token}/".encode()):
            return self._plain(403)
        return None if request.method in ("GET", "HEAD") else self._plain(405)

    def _plain(self, status: int) -> Response:
        return PlainTextResponse(WORDS[status], status, headers=self.headers)


def inline_hashes(page: str) -> str:
    """Hashes of the scripts inside the page, as the security policy needs them."""
    found = re.findall(r"<script(?![^>]*\bsrc=)[^>]*>(.*?)</script>", page, re.DOTALL)
    digests = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii") for script in found)
    return " ".join(f"'sha256-{digest}'" for digest in digests)

"""The server of the page: read only, for who knows its address, and for nobody else.

Every address begins with a token that is made anew for each server. No part of an address is ever taken for a path: it
names a layer, or one of the page's own files, which are read once when the server starts.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import secrets
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

from anyio.to_thread import current_default_thread_limiter
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from zlocus.errors import ConfigError, GeometryError
from zlocus.inspector import queries
from zlocus.inspector.folder import Patch, read_patch
from zlocus.inspector.inspection import Inspection
from zlocus.inspector.layers import Layer, composed, png_of
from zlocus.inspector.profile import profile
from zlocus.products.record import finite_only

THREADS = 8
TOKEN_BYTES = 24
TILE_PX = 256
TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json",
         ".svg": "image/svg+xml"}  # fmt: skip
# Scripts are the page's own files, and the one line in it that says where modules are.
POLICY = (
    "default-src 'none'; script-src 'self' {hashes}; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin", "Cross-Origin-Opener-Policy": "same-origin",
}  # fmt: skip
Answer = Callable[[Request], Response]


def new_token() -> str:
    """A token that nobody guesses."""
    return secrets.token_urlsafe(TOKEN_BYTES)


class Guard:
    """Lets through what comes from this page: the right token, host and origin, and only what reads.

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
            return  # no other kind of connection is ever accepted
        request = Request(scope)
        status = self._refusal(request)
        if status is not None:
            await PlainTextResponse(WORDS[status], status, headers=self.headers)(scope, receive, send)
            return

        async def send_guarded(message: Any) -> None:
            if message["type"] == "http.response.start":
                extra = [(name.lower().encode(), value.encode()) for name, value in self.headers.items()]
                message = {**message, "headers": [*message["headers"], *extra]}
            await send(message)

        # What is behind the token is all that the routes see.
        await self.app({**scope, "path": request.url.path[len(self.token) + 1 :]}, receive, send_guarded)

    def _refusal(self, request: Request) -> int | None:
        """Status of what is not let through."""
        if request.headers.get("host", "") not in self.hosts:
            return 403
        origin = request.headers.get("origin")
        if origin is not None and origin not in {f"http://{host}" for host in self.hosts}:
            return 403
        given = request.scope["path"].encode("utf-8", "replace")
        if not secrets.compare_digest(given[: len(self.token) + 2], f"/{self.token}/".encode()):
            return 403
        return None if request.method in ("GET", "HEAD") else 405


WORDS = {
    403: "Not allowed. Open the address that `zlocus inspect` printed when it started.",
    404: "There is nothing here.",
    405: "Nothing can be changed here.",
}


def page_files() -> dict[str, tuple[bytes, str]]:
    """The page's own files, content and type, by the only names that they are served by."""
    root = files("zlocus.inspector") / "static"

    def listed(folder: Traversable, prefix: str) -> Iterator[tuple[str, Traversable]]:
        for entry in folder.iterdir():
            if entry.is_dir():
                yield from listed(entry, f"{prefix}{entry.name}/")
            else:
                yield prefix + entry.name, entry

    return {
        name: (entry.read_bytes(), TYPES.get(name[name.rfind(".") :], "text/plain")) for name, entry in listed(root, "")
    }


def inline_hashes(page: str) -> str:
    """What the policy has to know of the scripts that stand in the page itself."""
    found = re.findall(r"<script(?![^>]*\bsrc=)[^>]*>(.*?)</script>", page, re.DOTALL)
    digests = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii") for script in found)
    return " ".join(f"'sha256-{digest}'" for digest in digests)


def application(inspection: Inspection, token: str, hosts: frozenset[str]) -> ASGIApp:
    """The page of an inspection. hosts : "host:port" under which it is asked for."""
    static = page_files()
    content = json_of(inspection.summary())

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        current_default_thread_limiter().total_tokens = THREADS
        yield

    routes = [
        Route("/", lambda request: file_of(static, "index.html")),
        Route("/static/{name:path}", lambda request: file_of(static, request.path_params["name"])),
        Route("/api/surface", lambda request: Response(content, media_type="application/json")),
        *(Route(f"/api/{name}", answered(inspection, answer)) for name, answer in ANSWERS.items()),
        Route("/tiles/{layer}/{level}/{col}/{row}.png", answered(inspection, tile)),
    ]
    app = Starlette(routes=routes, lifespan=lifespan, exception_handlers={404: nothing_here, 405: nothing_here})
    return Guard(app, token, hosts, POLICY.format(hashes=inline_hashes(static["index.html"][0].decode())))


def nothing_here(request: Request, error: Exception) -> Response:
    """For what is not known."""
    return PlainTextResponse(WORDS[404], 404)


def file_of(static: Mapping[str, tuple[bytes, str]], name: str) -> Response:
    """One of the page's own files."""
    if name not in static:
        return PlainTextResponse(WORDS[404], 404)
    content, kind = static[name]
    return Response(content, media_type=kind, headers={"Cache-Control": "no-cache"})


def answered(inspection: Inspection, answer: Callable[[Inspection, Request], Response]) -> Answer:
    """An answer in which what is wrong with the question is a sentence."""

    def endpoint(request: Request) -> Response:
        try:
            return answer(inspection, request)
        except GeometryError as error:
            return Response(json_of({"error": str(error)}), 404, media_type="application/json")
        except ConfigError as error:
            return Response(json_of({"error": str(error)}), 400, media_type="application/json")

    return endpoint


def state(inspection: Inspection, request: Request) -> Response:
    """How far the scene is."""
    queries.once(request.query_params.multi_items(), ())
    return Response(json_of(inspection.state()), media_type="application/json")


def cell(inspection: Inspection, request: Request) -> Response:
    """One cell, x and y in m, and what is to be changed."""
    allowed = {"x", "y", "reference", "window", *queries.SELECTION}
    values, left_out = queries.once(request.query_params.multi_items(), allowed, "without")
    x, y = (queries.number(values, name) for name in ("x", "y"))
    found = inspection.cell(x, y, queries.what_if(values, left_out))
    return Response(json_of(found), media_type="application/json")


def line(inspection: Inspection, request: Request) -> Response:
    """A profile from x0, y0 to x1, y1, m."""
    names = ("x0", "y0", "x1", "y1")
    values, _ = queries.once(request.query_params.multi_items(), names)
    x0, y0, x1, y1 = (queries.number(values, name, -queries.FARTHEST_M, queries.FARTHEST_M) for name in names)
    found = profile(inspection.folder, inspection.reference, (x0, y0), (x1, y1))
    return Response(json_of(found), media_type="application/json")


def heights(inspection: Inspection, request: Request) -> Response:
    """Heights of a patch, float32, row by row, NaN where there is none."""
    values, _ = queries.once(request.query_params.multi_items(), queries.PATCH)
    cells = read_patch(inspection.folder.path("dsm"), queries.patch(values), average=True)
    return Response(cells.values[0].astype("<f4").tobytes(), media_type="application/octet-stream")


def picture(inspection: Inspection, request: Request) -> Response:
    """Layers of a patch over each other: `layer` once for each, NAME or NAME:OPACITY, the lowest first."""
    values, names = queries.once(request.query_params.multi_items(), queries.PATCH, "layer")
    layers = [(layer_of(inspection, name), opacity) for name, opacity in map(queries.layer_and_opacity, names)]
    return Response(png_of(composed(layers, queries.patch(values))), media_type="image/png")


def tile(inspection: Inspection, request: Request) -> Response:
    """A square of `TILE_PX` pixels of a layer; at level n a pixel is 2 ** n cells a side."""
    queries.once(request.query_params.multi_items(), ("v",))
    values = {name: str(request.path_params[name]) for name in ("level", "col", "row")}
    level = queries.whole(values, "level", 0, queries.MOST_LEVELS)
    side = TILE_PX << level
    last_row, last_col = ((n - 1) // side for n in inspection.folder.shape)
    row, col = queries.whole(values, "row", 0, last_row), queries.whole(values, "col", 0, last_col)
    layer = layer_of(inspection, request.path_params["layer"])
    drawn = layer.draw(Patch(row * side, col * side, side, side, TILE_PX, TILE_PX))
    return Response(png_of(drawn), media_type="image/png", headers={"Cache-Control": "private, max-age=3600"})


def layer_of(inspection: Inspection, name: str) -> Layer:
    """A layer by its name.

    Raises
    ------
    GeometryError
        It is not there.
    """
    found = inspection.layer(name)
    if found is None:
        raise GeometryError(f"There is no layer {name[:40]!r}.")
    return found


def json_of(record: Any) -> bytes:
    """JSON, with null for every number that is not finite."""
    return json.dumps(finite_only(record), allow_nan=False).encode()


ANSWERS = {"state": state, "cell": cell, "profile": line, "heights": heights, "picture.png": picture}

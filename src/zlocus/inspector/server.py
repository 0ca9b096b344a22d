"""Routes of the page: answers to its requests.

No part of an address is used as a path. It names a layer, or one of the page's own files, which are read once when the
server starts.
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Iterator, Mapping
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from zlocus.core.errors import ConfigError, GeometryError, ZlocusError
from zlocus.core.parallel import busy
from zlocus.inspector import queries
from zlocus.inspector.folder import Patch
from zlocus.inspector.guard import POLICY, WORDS, Guard, inline_hashes
from zlocus.inspector.inspection import Inspection
from zlocus.inspector.layers import Layer, composed, png_of
from zlocus.inspector.profile import profile
from zlocus.inspector.relief import relief_of
from zlocus.io.run_record import finite_only

THREADS = 6
TILE_PX = 256
TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json",
         ".svg": "image/svg+xml"}  # fmt: skip
Answer = Callable[[Request], Awaitable[Response]]
Reply = Callable[[Inspection, Request], Response]


def page_files() -> dict[str, tuple[bytes, str]]:
    """The page's own files: content and type by the only names under which they are served."""
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


def application(inspection: Inspection, token: str, hosts: frozenset[str]) -> ASGIApp:
    """The web application of an inspection. hosts : "host:port" at which browsers open it."""
    static = page_files()
    # Clicks and pictures each have one slot, so that an abandoned one does not delay the other requests.
    # So do the matches of what the matcher weighed, which take seconds.
    clicks, weighed, pictures = CapacityLimiter(1), CapacityLimiter(1), CapacityLimiter(1)
    others = CapacityLimiter(THREADS)

    async def of_page(request: Request) -> Response:
        return file_of(static, request.path_params.get("name", "index.html"))

    async def of_state(request: Request) -> Response:
        return Response(json_of(inspection.state()), media_type="application/json")

    routes = [
        Route("/", of_page),
        Route("/static/{name:path}", of_page),
        Route("/api/state", of_state),
        Route("/api/cell", answered(inspection, cell, clicks)),
        Route("/api/matcher", answered(inspection, matcher, weighed)),
        Route("/api/heights", answered(inspection, heights, pictures)),
        Route("/api/picture.png", answered(inspection, picture, pictures)),
        Route("/api/surface", answered(inspection, surface, others)),
        Route("/api/profile", answered(inspection, line, others)),
        Route("/tiles/{layer}/{level}/{col}/{row}.png", answered(inspection, tile, others)),
    ]
    app = Starlette(routes=routes, exception_handlers={404: nothing_here, 405: nothing_here})
    return Guard(app, token, hosts, POLICY.format(hashes=inline_hashes(static["index.html"][0].decode())))


async def nothing_here(request: Request, error: Exception) -> Response:
    """Answer for unknown addresses."""
    return PlainTextResponse(WORDS[404], 404)


def file_of(static: Mapping[str, tuple[bytes, str]], name: str) -> Response:
    """One of the page's own files."""
    if name not in static:
        return PlainTextResponse(WORDS[404], 404)
    content, kind = static[name]
    return Response(content, media_type=kind, headers={"Cache-Control": "no-cache"})


def answered(inspection: Inspection, answer: Reply, slots: CapacityLimiter) -> Answer:
    """Wrap a reply so that errors become sentences. slots : limit on the number of requests at one time."""

    def said(request: Request) -> Response:
        try:
            with busy():
                inspection.check_unchanged()
                return answer(inspection, request)
        except ZlocusError as error:
            return Response(json_of({"error": str(error)}), status_of(error), media_type="application/json")

    async def endpoint(request: Request) -> Response:
        async with slots:
            if await request.is_disconnected():
                return Response(status_code=408)
            return await run_sync(said, request)

    return endpoint


def status_of(error: ZlocusError) -> int:
    """HTTP status of an error: bad request, not found, or conflict where files have changed."""
    return 400 if isinstance(error, ConfigError) else 404 if isinstance(error, GeometryError) else 409


def surface(inspection: Inspection, request: Request) -> Response:
    """What the page has to know first."""
    queries.once(request.query_params.multi_items(), ())
    return Response(json_of(inspection.summary()), media_type="application/json")


def cell(inspection: Inspection, request: Request) -> Response:
    """One cell, x and y in m, and what is to be changed."""
    allowed = {"x", "y", "reference", "window", *queries.SELECTION}
    values, left_out = queries.once(request.query_params.multi_items(), allowed, "without")
    x, y = (queries.number(values, name) for name in ("x", "y"))
    record = inspection.cell(x, y, queries.what_if(values, left_out))
    return Response(json_of(record), media_type="application/json")


def matcher(inspection: Inspection, request: Request) -> Response:
    """What the matcher weighed at a cell, x and y in m."""
    values, _ = queries.once(request.query_params.multi_items(), ("x", "y"))
    x, y = (queries.number(values, name) for name in ("x", "y"))
    return Response(json_of(inspection.matcher(x, y)), media_type="application/json")


def line(inspection: Inspection, request: Request) -> Response:
    """A profile from x0, y0 to x1, y1, m."""
    names = ("x0", "y0", "x1", "y1")
    values, _ = queries.once(request.query_params.multi_items(), names)
    x0, y0, x1, y1 = (
        queries.number(values, name, -queries.MAX_COORDINATE_M, queries.MAX_COORDINATE_M) for name in names
    )
    record = profile(inspection.folder, inspection.reference, (x0, y0), (x1, y1))
    return Response(json_of(record), media_type="application/json")


def heights(inspection: Inspection, request: Request) -> Response:
    """Heights of a patch and where its surface is broken, see `BrokenRelief.content`."""
    values, _ = queries.once(request.query_params.multi_items(), queries.PATCH)
    relief = relief_of(inspection.folder, queries.patch(values))
    return Response(relief.content, media_type="application/octet-stream")


def picture(inspection: Inspection, request: Request) -> Response:
    """Layers of a patch, composed: one parameter `layer` for each, NAME or NAME:OPACITY, the lowest first."""
    values, names = queries.once(request.query_params.multi_items(), queries.PATCH, "layer")
    if len(names) > queries.MAX_LAYERS:
        raise queries.BadQuery(f"A picture has {queries.MAX_LAYERS} layers at most.")
    layers = [(layer_of(inspection, name), opacity) for name, opacity in map(queries.layer_and_opacity, names)]
    return Response(png_of(composed(layers, queries.patch(values))), media_type="image/png")


def tile(inspection: Inspection, request: Request) -> Response:
    """A square of `TILE_PX` pixels of a layer; at level n a pixel is 2 ** n cells a side."""
    queries.once(request.query_params.multi_items(), ("of",))
    values = {name: str(request.path_params[name]) for name in ("level", "col", "row")}
    level = queries.whole(values, "level", 0, queries.MAX_LEVELS)
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
        There is no such layer.
    """
    layer = inspection.layer(name)
    if layer is None:
        raise GeometryError(f"There is no layer {name[:40]!r}.")
    return layer


def json_of(record: Any) -> bytes:
    """JSON with null for every number that is not finite."""
    return json.dumps(finite_only(record), allow_nan=False).encode()

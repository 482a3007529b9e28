"""The addresses of the dashboard and what they answer."""

import asyncio
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

from aiohttp import web

from msk_ray.dashboard.guard import Access, guard, set_headers
from msk_ray.dashboard.library import Library, Unknown
from msk_ray.dashboard.plots import plotly_library
from msk_ray.errors import ConfigError, MskRayError
from msk_ray.experiment.damage import Limits, cut, field, parse_object
from msk_ray.experiment.notes import write_note
from msk_ray.report.page import FILES

_LARGEST = 64 * 1024
"""Maximum size of a request's body [B]."""
_NOTE = Limits(_LARGEST, _LARGEST)
_MEDIA = {".mp4": "video/mp4", ".png": "image/png"}
_REPORT, _DASHBOARD = "msk_ray.report", "msk_ray.dashboard"
_STATIC = {
    "style.css": (_REPORT, "page/style.css"),
    "echarts.js": (_REPORT, "page/echarts/echarts.min.js"),
    "charts.js": (_REPORT, "page/charts.js"),
    "script.js": (_REPORT, "page/script.js"),
    "live.js": (_DASHBOARD, "page/live.js"),
    "plots.js": (_DASHBOARD, "page/plots.js"),
}


def make_runner(library: Library, access: Access, shutdown_timeout: float = 1.0) -> web.AppRunner:
    """The server, not listening yet. It decompresses no bodies, because it would do so even for refused requests."""
    app = _make_app(library, access)
    return web.AppRunner(app, access_log=None, shutdown_timeout=shutdown_timeout, auto_decompress=False)


def _make_app(library: Library, access: Access) -> web.Application:
    app = web.Application(middlewares=[guard(access), _errors], client_max_size=_LARGEST)
    app.on_response_prepare.append(set_headers)
    pages = _Pages(library)
    app.add_routes(
        [
            web.get("/", pages.index),
            web.get("/version", pages.index_version),
            web.get("/compare", pages.compare),
            web.get("/static/{file}", pages.static),
            web.get("/e/{name}", pages.slash),
            web.get("/e/{name}/", pages.experiment),
            web.get("/e/{name}/version", pages.version),
            web.get("/e/{name}/plots", pages.plots),
            web.get("/e/{name}/report/{file}", pages.report_file),
            web.get("/e/{name}/trials/{trial}/{file:.+}", pages.trial_file),
            web.post("/e/{name}/trials/{trial}/note", pages.note),
        ]
    )
    return app


@web.middleware
async def _errors(request: web.Request, handler: Any) -> web.StreamResponse:
    """Turn this package's errors into responses; anything else is logged by aiohttp and answered with 500."""
    try:
        response: web.StreamResponse = await handler(request)
    except Unknown as error:
        raise web.HTTPNotFound(text=f"{error}\n") from None
    except ConfigError as error:
        raise web.HTTPBadRequest(text=f"{error}\n") from None
    except MskRayError as error:
        raise web.HTTPConflict(text=f"{error}\n") from None
    return response


class _Pages:
    """The handlers. They read files in a thread, so that other requests are answered meanwhile."""

    def __init__(self, library: Library) -> None:
        self._library = library

    async def index(self, request: web.Request) -> web.Response:
        return _html((await asyncio.to_thread(self._library.index)).html)

    async def index_version(self, request: web.Request) -> web.Response:
        return web.json_response({"version": (await asyncio.to_thread(self._library.index)).version})

    async def compare(self, request: web.Request) -> web.Response:
        names = request.query.getall("e", [])
        if not names:
            raise web.HTTPFound("/")
        others = urlencode([("with", name) for name in names[1:]])
        raise web.HTTPFound(f"/e/{quote(names[0], safe='')}/{f'?{others}' if others else ''}")

    async def slash(self, request: web.Request) -> web.Response:
        raise web.HTTPFound(f"/e/{quote(request.match_info['name'], safe='')}/")

    async def experiment(self, request: web.Request) -> web.Response:
        return _html((await asyncio.to_thread(self._library.page, _names(request))).html)

    async def version(self, request: web.Request) -> web.Response:
        return web.json_response({"version": (await asyncio.to_thread(self._library.page, _names(request))).version})

    async def plots(self, request: web.Request) -> web.Response:
        return _html(await asyncio.to_thread(self._library.plots, request.match_info["name"]))

    async def report_file(self, request: web.Request) -> web.StreamResponse:
        name, file = request.match_info["name"], request.match_info["file"]
        path = await asyncio.to_thread(self._library.report_file, name, file)
        return await self._send(request, path, {"Content-Type": _MEDIA[path.suffix]})

    async def trial_file(self, request: web.Request) -> web.StreamResponse:
        name, trial, file = (request.match_info[part] for part in ("name", "trial", "file"))
        if file not in FILES:
            raise Unknown(f"no file {file} of a trial; there are {', '.join(FILES)}")
        path = await asyncio.to_thread(self._library.trial_folder, name, trial) / file
        if path.suffix == ".pt":
            attached = {"Content-Disposition": f'attachment; filename="{trial}_{path.name}"'}
            return await self._send(request, path, {**attached, "Content-Type": "application/octet-stream"})
        # Never as HTML: the text may come from anywhere.
        return await self._send(request, path, {"Content-Type": "text/plain; charset=utf-8"})

    async def _send(self, request: web.Request, path: Path, headers: Mapping[str, str]) -> web.StreamResponse:
        """Send a file of the storage."""
        opened = await asyncio.to_thread(self._library.open, path)
        with opened as file:
            # By its descriptor: this is the file that was checked, even if the path now leads elsewhere.
            response = web.FileResponse(f"/proc/self/fd/{file.fileno()}", headers=headers)
            await response.prepare(request)
        return response

    async def note(self, request: web.Request) -> web.Response:
        name, trial = request.match_info["name"], request.match_info["trial"]
        try:
            text = field(parse_object(await request.read(), _NOTE), "text", str)
        except ValueError as error:
            raise web.HTTPBadRequest(text=f'write {{"text": "..."}}: {cut(error)}\n') from None
        await asyncio.to_thread(self._library.write, write_note, name, trial, text)
        return web.json_response({})

    async def static(self, request: web.Request) -> web.Response:
        name = request.match_info["file"]
        kept = {"Cache-Control": "private, max-age=600"}
        if name == "plotly.js":
            return web.Response(
                text=await asyncio.to_thread(plotly_library), content_type="text/javascript", headers=kept
            )
        if name not in _STATIC:
            raise web.HTTPNotFound
        kind = "text/css" if name.endswith(".css") else "text/javascript"
        return web.Response(text=_static(name), content_type=kind, headers=kept)


@cache
def _static(name: str) -> str:
    package, path = _STATIC[name]
    return files(package).joinpath(path).read_text(encoding="utf-8")


def _names(request: web.Request) -> Sequence[str]:
    return list(dict.fromkeys([request.match_info["name"], *request.query.getall("with", [])]))


def _html(text: str) -> web.Response:
    return web.Response(text=text, content_type="text/html")

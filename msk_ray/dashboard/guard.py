"""Which requests the dashboard answers. Every request passes through here."""

import ipaddress
import re
from dataclasses import dataclass

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

_HEADERS = {
    # Everything comes from the server itself; ECharts and Plotly write styles into their elements.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; media-src 'self'; connect-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}


@dataclass(frozen=True)
class Access:
    """What the command line allows."""

    local: bool
    """Whether it listens to this machine only."""
    names: tuple[str, ...]
    """Additional host names that it answers to, in lower case."""
    may_write: bool
    """Whether notes may be written."""

    def knows(self, host: str) -> bool:
        """Whether a request with this Host header was meant for this server.

        A foreign web site may let its own name resolve to this machine's address (DNS rebinding); a browser then sends
        that name here. This cannot happen with IP addresses and `localhost`.
        """
        name = _name_of(host)
        if name == "localhost" or name in self.names:
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return address.is_loopback or not self.local


_HOST = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([A-Za-z0-9_-]+(?:\.[A-Za-z0-9_-]+)*)\.?)(?::[0-9]{1,5})?")


def _name_of(host: str) -> str:
    """The name in a Host header, in lower case, without port, brackets and final dot; empty if it is malformed."""
    match = _HOST.fullmatch(host)
    return "" if match is None else (match[1] or match[2]).lower()


def guard(access: Access) -> Middleware:
    """A middleware that refuses requests meant for another server, and writes that are not allowed or come from
    another site."""

    @web.middleware
    async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
        hosts = request.headers.getall("Host", [""])
        host = hosts[0] if len(hosts) == 1 else ""
        if not access.knows(host):
            name = _name_of(host) or "NAME"
            raise web.HTTPMisdirectedRequest(
                text=f"not known by this name; use its address, or start it with --allow-host {name}\n"
            )
        if request.method not in ("GET", "HEAD"):
            _check_writing(request, host, access)
        return await handler(request)

    return check


def _check_writing(request: web.Request, host: str, access: Access) -> None:
    if not access.may_write:
        raise web.HTTPForbidden(text="read-only: start it with --allow-notes\n")
    # A page of another site may send requests here too, with its own Origin; a form cannot send JSON.
    if request.headers.get("Origin") not in (f"http://{host}", f"https://{host}"):
        raise web.HTTPForbidden(text="not from a page of this dashboard\n")
    # JSON is UTF-8 (RFC 8259). A body is not unpacked for anybody: a few bytes may become gigabytes.
    utf8 = (request.charset or "utf-8").lower() in ("utf-8", "utf8")
    if request.content_type != "application/json" or not utf8 or "Content-Encoding" in request.headers:
        raise web.HTTPUnsupportedMediaType(text="write application/json in UTF-8, not compressed\n")


async def set_headers(request: web.Request, response: web.StreamResponse) -> None:
    """Set the headers of every response, including refusals."""
    response.headers.update(_HEADERS)
    response.headers.setdefault("Cache-Control", "no-store")

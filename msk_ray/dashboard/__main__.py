"""`python -m msk_ray.dashboard`: the experiments of a storage folder as live pages in a browser."""

import asyncio
import contextlib
import ipaddress
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from aiohttp import web

from msk_ray.cli import Parser, port_number, run, seconds
from msk_ray.dashboard.app import make_runner
from msk_ray.dashboard.films import Films
from msk_ray.dashboard.guard import Access
from msk_ray.dashboard.library import Library
from msk_ray.errors import ConfigError, StorageError
from msk_ray.experiment.layout import MANIFEST_FILE, SPACE_FILE
from msk_ray.text import printable

DESCRIPTION = """\
Serve the report of every experiment in a folder as a page that follows its trials while they run. In addition to the
report it shows a film of the best policy so far and Optuna's plots (with the extra msk-ray[dashboard]), takes notes on
trials, and puts several experiments side by side.

It only reads the experiments' files and never disturbs a sweep. Only this machine can reach it, unless --host says
otherwise: then others can read everything in the folder, and write notes only with --allow-notes. From another machine,
an ssh tunnel is safer: ssh -L 8321:127.0.0.1:8321 HOST."""

EXAMPLES = """\
  python -m msk_ray.dashboard                       # the experiments in runs/, at http://127.0.0.1:8321/
  python -m msk_ray.dashboard /shared/runs --port 0 --refresh 30
  python -m msk_ray.dashboard --host 0.0.0.0        # for the network, read-only"""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.dashboard", DESCRIPTION, EXAMPLES)
    p.add_argument(
        "storage",
        nargs="?",
        type=Path,
        default=Path("runs"),
        metavar="STORAGE",
        help="folder of experiments (default: runs/)",
    )
    p.add_argument("--host", default="127.0.0.1", metavar="ADDRESS", help="address to listen on (default: %(default)s)")
    p.add_argument(
        "--port", type=port_number, default=8321, metavar="N", help="port (default: %(default)s; 0: any free one)"
    )
    p.add_argument(
        "--refresh",
        type=seconds,
        default=5.0,
        metavar="S",
        help="check the files for changes every S seconds (default: 5)",
    )
    p.add_argument(
        "--no-films",
        action="store_true",
        help="make no films of the best policies; each takes one CPU core for a while, at low priority",
    )
    p.add_argument("--allow-notes", action="store_true", help="with --host: everyone who can reach it may write notes")
    p.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="accept requests for this host name, such as a proxy's; IP addresses are always accepted",
    )
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    if not args.storage.is_dir():
        raise StorageError(f"no folder {args.storage}: give the folder of your experiments")
    if (args.storage / MANIFEST_FILE).exists() or (args.storage / SPACE_FILE).exists():
        raise StorageError(
            f"{args.storage} is an experiment: give the folder above it, {args.storage.resolve().parent}"
        )
    local = _is_loopback(args.host)
    if args.allow_notes and local and not args.allow_host:
        raise ConfigError("--allow-notes: notes can be written from this machine anyway; leave it out")
    names = tuple(name.lower() for name in args.allow_host)
    access = Access(local, names, args.allow_notes or (local and not names))
    films = None if args.no_films else Films()
    try:
        asyncio.run(_serve(Library(args.storage, args.refresh, access.may_write, films), access, args.host, args.port))
    finally:
        if films is not None:
            films.close()
    return 0


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise ConfigError(f"--host {host}: write an address of this machine, such as 127.0.0.1 or 0.0.0.0") from None


async def _serve(library: Library, access: Access, host: str, port: int) -> None:
    """Answer until the process is asked to stop."""
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    runner = make_runner(library, access)
    await runner.setup()
    try:
        site = web.TCPSite(runner, host, port)
        try:
            await site.start()
        except OSError as error:
            why = error.strerror or str(error)
            raise ConfigError(f"cannot listen on {host} port {port}: {why}; write another --port, or 0") from None
        shown = next(iter(runner.addresses))
        address = f"[{shown[0]}]" if ":" in shown[0] else shown[0]
        notes = "" if access.may_write else ", read-only"
        print(
            printable(f"dashboard    http://{address}:{shown[1]}/ ({library.storage}{notes}); Ctrl-C ends it"),
            flush=True,
        )
        await stop.wait()
    finally:
        with contextlib.suppress(asyncio.CancelledError):
            await runner.cleanup()


if __name__ == "__main__":
    sys.exit(run(main))

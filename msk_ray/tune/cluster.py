"""`python -m msk_ray.tune.cluster`: checks whether all nodes of a Ray cluster have joined, for scripts that start
one."""

import sys
import time
from collections.abc import Sequence

import ray

from msk_ray.cli import Parser, run
from msk_ray.tune.session import check_reachable

DESCRIPTION = "Exit code: 0 if at least N nodes are alive, 1 if fewer are or nothing answers at the address."
EXAMPLES = """\
  python -m msk_ray.tune.cluster --address 10.0.0.1:6379 --nodes 2
  python -m msk_ray.tune.cluster --address auto --nodes 3 --wait 900   # wait up to 900 s"""
_PAUSE_S = 5.0


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.tune.cluster", DESCRIPTION, EXAMPLES)
    p.add_argument("--address", required=True, metavar="HOST:PORT", help="'auto' for the cluster this machine is in")
    p.add_argument("--nodes", required=True, type=int, metavar="N")
    p.add_argument("--wait", type=float, default=0.0, metavar="S", help="seconds to wait for them (default: 0)")
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    deadline = time.monotonic() + args.wait
    while True:
        try:
            alive = _alive(args.address)
        except OSError as error:  # ConnectionError too
            print(f"nothing answers at {args.address} yet: {' '.join(str(error).split())}", flush=True)
        else:
            print(f"{alive} of {args.nodes} node(s) have joined", flush=True)
            if alive >= args.nodes:
                return 0
        if time.monotonic() + _PAUSE_S > deadline:
            return 1
        time.sleep(_PAUSE_S)


def _alive(address: str) -> int:
    """The number of nodes alive.

    Raises:
        OSError: nothing answers at the address.
    """
    check_reachable(address)
    ray.init(address=address, logging_level="ERROR", log_to_driver=False)
    alive: int = sum(node["Alive"] for node in ray.nodes())
    ray.shutdown()
    return alive


if __name__ == "__main__":
    sys.exit(run(main))

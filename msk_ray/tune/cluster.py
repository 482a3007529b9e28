"""`python -m msk_ray.tune.cluster`: have all nodes of a Ray cluster joined? For scripts that start one."""

import sys
from collections.abc import Sequence

import ray

from msk_ray.cli import Parser, run

DESCRIPTION = "Exit code: 0 if at least N nodes are alive, 1 if fewer are or nobody answers at the address."
EXAMPLES = "  python -m msk_ray.tune.cluster --address 10.0.0.1:6379 --nodes 2"


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    p = Parser("python -m msk_ray.tune.cluster", DESCRIPTION, EXAMPLES)
    p.add_argument("--address", required=True, metavar="HOST:PORT")
    p.add_argument("--nodes", required=True, type=int, metavar="N")
    args = p.parse_args(argv)
    try:
        ray.init(address=args.address, logging_level="ERROR", log_to_driver=False)
    except ConnectionError:
        print(f"nobody answers at {args.address} yet", flush=True)
        return 1
    alive = sum(node["Alive"] for node in ray.nodes())
    ray.shutdown()
    print(f"{alive} of {args.nodes} node(s) have joined", flush=True)
    return 0 if alive >= args.nodes else 1


if __name__ == "__main__":
    sys.exit(run(main))

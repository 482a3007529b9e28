"""`python -m msk_ray.tune.ray_probe`: whether Ray starts as for a sweep, for `msk-ray doctor`.

It runs one task and prints the result as JSON. A separate process, because a time limit on Ray's start can only be
enforced from outside.
"""

import json
import sys

import ray

from msk_ray.tune.session import ray_session


def _versions() -> dict[str, str]:
    """Runs in a worker, which must be able to import the package."""
    import msk_ray

    return {"msk_ray": msk_ray.__version__, "python": sys.version.split()[0]}


def main() -> None:
    """Print {"worker": versions, "cpus", "gpus"} as the last line."""
    with ray_session(None, dashboard=False, trials=False):
        worker = ray.get(ray.remote(_versions).options(num_cpus=1).remote())
        total = ray.cluster_resources()
    print(json.dumps({"worker": worker, "cpus": total.get("CPU", 0), "gpus": total.get("GPU", 0)}))


if __name__ == "__main__":
    main()

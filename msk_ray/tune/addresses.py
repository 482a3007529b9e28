"""Whether a Ray cluster answers at an address."""

import socket

_LIMIT_S = 20.0


def check_reachable(address: str) -> None:
    """See whether anybody listens at HOST:PORT: Ray itself would try for minutes. Other kinds of addresses pass.

    Raises:
        OSError: nobody does.
    """
    host, _, port = address.rpartition(":")
    if "://" not in address and port.isdigit():
        socket.create_connection((host, int(port)), timeout=_LIMIT_S).close()

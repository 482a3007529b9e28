"""Whether a Ray cluster answers at an address."""

import socket

_LIMIT_S = 20.0


def check_reachable(address: str) -> None:
    """Check that something listens at HOST:PORT, because Ray itself would try for minutes. Other addresses pass.

    Raises:
        OSError: nothing listens there.
    """
    host, _, port = address.rpartition(":")
    if "://" not in address and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=_LIMIT_S).close()

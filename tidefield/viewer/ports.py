"""Where pages listen."""

from __future__ import annotations

import socket
import sys

from tidefield.errors import RunError

LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")
"""Names of this machine that no other machine reaches."""


def require_port(host: str, port: int) -> socket.AddressFamily:
    """Raise now what a server on a port that cannot be had would not say: viser silently takes the next one.

    Returns:
        The family of the host's address: IPv4 or IPv6.

    Raises:
        RunError: the port is in use, not allowed, or the host is not this machine's.
    """
    if not 0 <= port <= 65535:
        raise RunError(f"--port {port} was asked for: expected 0 to 65535; choose another")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            # On Windows SO_REUSEADDR also lends ports that are in use.
            option = socket.SO_EXCLUSIVEADDRUSE if sys.platform == "win32" else socket.SO_REUSEADDR
            probe.setsockopt(socket.SOL_SOCKET, option, 1)
            probe.bind(address)
    except OSError as error:
        raise RunError(
            f"port {port} of {host} cannot be listened on ({error.strerror or error}): expected a free port of this "
            "machine; choose another with --port, or --port 0 for any that is free"
        ) from error
    return family


def page_address(host: str, port: int) -> str:
    """The address of a page, for a browser on this machine."""
    if host in ("0.0.0.0", "::"):  # all addresses
        host = "localhost"
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"

"""A connection to a web server with a time limit that holds however slowly the server answers."""

from __future__ import annotations

import errno
import http.client
import socket
import ssl
import threading
from contextlib import suppress
from typing import Self

_MOST_SECONDS = 300.0
"""Longest time in seconds that all requests of one visit may take together."""
_MOST_SILENT_SECONDS = 30.0
"""Longest wait for the next byte of a server, in seconds."""
REFUSALS = frozenset({400, 401, 495, 496})
"""Status with which web servers answer to a client whose certificate they refuse (nginx: 400)."""


def is_tls_ended_by_server(error: BaseException | None) -> bool:
    """Return whether an error says that the server ended TLS, perhaps to refuse the certificate.

    With TLS 1.3 this may be an alert, or only the end of the connection.
    """
    certificate_error = ssl.SSLCertVerificationError  # the server's own certificate is wrong
    return isinstance(error, ssl.SSLError) and not isinstance(error, certificate_error)


def error_clause(error: Exception) -> str:
    """Return why a server could not be asked, as a clause without any text from the server."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not valid: {error.verify_message}"
    if isinstance(error, ssl.SSLError):
        return f"TLS fails: {(error.reason or str(error)).lower().replace('_', ' ')}"
    if isinstance(error, TimeoutError):
        return error.strerror or "it does not answer"
    if isinstance(error, http.client.HTTPException) and not isinstance(error, OSError):
        return f"it does not speak HTTP: {type(error).__name__}"
    return (error.strerror if isinstance(error, OSError) else "") or str(error)


class GuardedConnection(http.client.HTTPConnection):
    """A connection that is cut off when `_MOST_SECONDS` are over, also in its handshake.

    A context manager: the time begins when it is entered.
    """

    def __init__(self, host: str, port: int, context: ssl.SSLContext | None) -> None:
        """Prepare to connect; ``context`` is None for a connection without TLS."""
        super().__init__(host, port, timeout=_MOST_SILENT_SECONDS)
        self._context = context
        self._guard: socket.socket | None = None
        self._timer = threading.Timer(_MOST_SECONDS, self._cut_off)
        self._timer.daemon = True
        self.is_cut_off = False

    def __enter__(self) -> Self:
        self._timer.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._timer.cancel()
        self.end()

    def connect(self) -> None:
        """Connect, and agree on TLS if there is a context."""
        self._end_guard()
        plain = socket.create_connection((self.host, self.port), _MOST_SILENT_SECONDS)
        self._guard = plain.dup()
        self.sock = plain
        if self.is_cut_off:  # the time was over during the handshake
            raise TimeoutError(errno.ETIMEDOUT, "it takes too long")
        if self._context:
            self.sock = self._context.wrap_socket(plain, server_hostname=self.host)

    def end(self) -> None:
        """Close the connection and an unfinished answer, which `close` leaves open."""
        self.close()
        self._end_guard()

    def _end_guard(self) -> None:
        if self._guard:
            self._guard.close()
            self._guard = None

    def _cut_off(self) -> None:
        """End all reading and writing now."""
        self.is_cut_off = True
        guard = self._guard
        with suppress(OSError):
            if guard:
                guard.shutdown(socket.SHUT_RDWR)

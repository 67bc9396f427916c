"""Transport of published files to the robot: by https, by http, or from a folder of the robot.

`tuf` fetches files through one of the two classes; the caller has to enter the ``connection`` of
the class before. Both classes limit the size and the time of answers, follow no redirect and no
link, and leave the verification of files to `tuf`.
"""

from __future__ import annotations

import errno
import http.client
import ssl
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import IO
from urllib.parse import urlsplit

from tuf.api.exceptions import (
    DownloadError,
    DownloadHTTPError,
    DownloadLengthMismatchError,
    SlowRetrievalError,
)
from tuf.ngclient.fetcher import FetcherInterface

from sros_tool.agent.connection import GuardedConnection, error_clause
from sros_tool.errors import SrosError, UsageError
from sros_tool.folders import Folder

_BLOCK_BYTES = 1 << 16


class _Transport(FetcherInterface):
    """A TUF fetcher that names the file whose size is wrong."""

    base: str
    timestamp = b""
    """The content of the timestamp that was fetched last."""

    def download_bytes(self, url: str, max_length: int) -> bytes:
        """Return a file, as the base class does; remember the timestamp."""
        data = super().download_bytes(url, max_length)
        if url.endswith("/metadata/timestamp.json"):
            self.timestamp = data
        return data

    @contextmanager
    def download_file(self, url: str, max_length: int) -> Iterator[IO[bytes]]:
        try:
            with super().download_file(url, max_length) as file:
                yield file
        except DownloadLengthMismatchError as error:
            path = url.removeprefix(f"{self.base}/")
            text = f"the file {path} is larger than the {max_length} bytes that it may have"
            raise DownloadLengthMismatchError(text) from error


class FolderTransport(_Transport):
    """A TUF fetcher for a publishing folder on this machine, such as on a USB stick."""

    base = "folder:"
    connection = nullcontext()

    def __init__(self, folder: Path, *, max_bytes: int) -> None:
        """Read from ``folder``; each file may have at most ``max_bytes`` bytes."""
        self._folder = folder
        self._most = max_bytes

    def _fetch(self, url: str) -> Iterator[bytes]:
        path = url.removeprefix(f"{self.base}/")
        try:
            folder = Folder(self._folder)
        except OSError as error:
            raise DownloadError(f"'{self._folder}': {error.strerror}") from error
        with folder:
            try:
                yield folder.read(path, max_bytes=self._most)
            except FileNotFoundError as error:
                raise DownloadHTTPError(f"'{self._folder / path}' does not exist", 404) from error
            except OSError as error:
                text = f"'{self._folder / path}': {error.strerror}"
                if error.errno == errno.EFBIG:
                    raise DownloadLengthMismatchError(text) from error
                raise DownloadError(text) from error
            except SrosError as error:
                raise DownloadError(error.what) from error


class HttpTransport(_Transport):
    """A TUF fetcher for a publishing folder on a web server, over one connection.

    The ``connection`` has to be entered, and is cut off after some minutes.
    """

    def __init__(
        self,
        url: str,
        *,
        certificate: tuple[Path, Path] | None = None,
        tls_ca: Path | None = None,
    ) -> None:
        """Prepare to get files below ``url``, without connecting.

        Args:
            url: ``http://HOST[:PORT][/PATH]`` or ``https://…``.
            certificate: files (PEM) of the client's certificate and its key.
            tls_ca: file (PEM) of the server's CAs; None: the CAs of the system.

        Raises:
            UsageError: ``url`` has another form.
            OSError: a certificate file cannot be read, or has no certificate.
        """
        parts = urlsplit(url)
        self.base = url.rstrip("/")
        self._path = parts.path.rstrip("/")
        secure = parts.scheme == "https"
        try:
            port = parts.port or (443 if secure else 80)
        except ValueError:
            port = 0
        if (
            not parts.hostname
            or not port
            or parts.query
            or parts.fragment
            or "@" in parts.netloc
            or not (url.isascii() and url.isprintable())
            or " " in url
        ):
            raise UsageError(
                f"{url!r} is not the address of a publishing folder",
                "The address must have a host and a path, and no user, '?' or '#'.",
                "Write it as in https://HOST/fleet.",
            )
        context = ssl.create_default_context(cafile=tls_ca) if secure else None
        if context and certificate:
            context.load_cert_chain(*certificate)
        self.connection = GuardedConnection(parts.hostname, port, context)

    def _fetch(self, url: str) -> Iterator[bytes]:
        path = f"{self._path}{url.removeprefix(self.base)}"
        response = None
        try:
            response = self._response(path)
            if response.status != http.client.OK:
                text = f"it answers {response.status} for {path}"
                raise DownloadHTTPError(text, response.status)
            while block := response.read1(_BLOCK_BYTES):
                yield block
        except (OSError, http.client.HTTPException) as error:
            if self.connection.is_cut_off:
                raise SlowRetrievalError(f"{path} takes too long") from error
            raise DownloadError(error_clause(error)) from error
        finally:
            if response is None or not response.isclosed():
                self.connection.end()
        if self.connection.is_cut_off:  # the answer may be incomplete
            raise SlowRetrievalError(f"{path} takes too long")

    def _response(self, path: str) -> http.client.HTTPResponse:
        """Send the request and return the response.

        If the server has closed the connection since the last request, the request is sent again.
        """
        kept = self.connection.sock is not None
        try:
            return self._request(path)
        except (ConnectionError, http.client.RemoteDisconnected):
            if not kept or self.connection.is_cut_off:
                raise
        self.connection.close()
        return self._request(path)

    def _request(self, path: str) -> http.client.HTTPResponse:
        self.connection.request("GET", path, headers={"User-Agent": "sros"})
        return self.connection.getresponse()

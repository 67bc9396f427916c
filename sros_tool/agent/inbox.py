"""Sending the robot's message to its inbox at home: a folder, or a server that takes PUT."""

from __future__ import annotations

import errno
import http.client
import ssl
from pathlib import Path
from urllib.parse import quote, urlsplit

from sros_tool.agent.connection import GuardedConnection
from sros_tool.agent.fetch import ClientCertificate
from sros_tool.errors import UnavailableError
from sros_tool.files import staged_file
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import MESSAGE_FILE


def send(
    inbox: str,
    robot: str,
    message: bytes,
    *,
    client_certificate: ClientCertificate | None = None,
    tls_ca: Path | None = None,
) -> None:
    """Put a message into the inbox, in place of the robot's last one.

    Args:
        inbox: ``https://…``, ``http://…``, or the path of a folder.
        robot: the name of this robot.
        message: the signed message.
        client_certificate: certificate and key for TLS.
        tls_ca: CA certificates (PEM) of the server; None: those of the system.

    Raises:
        UnavailableError: the inbox cannot be reached, or does not take the message.
    """
    if not inbox.startswith(("https://", "http://")):
        _write(Path(inbox), robot, message)
        return
    what = f"the inbox {inbox} does not take the message"
    try:
        url = urlsplit(inbox)
        where = f"{url.path.rstrip('/')}/{quote(robot)}/{MESSAGE_FILE}"
        context = None
        if url.scheme == "https":
            context = ssl.create_default_context(cafile=str(tls_ca) if tls_ca else None)
            if client_certificate:
                context.load_cert_chain(client_certificate.certificate, client_certificate.key)
        port = url.port or (443 if context else 80)
        with GuardedConnection(url.hostname or "", port, context) as connection:
            headers = {"Content-Type": "application/pkcs7-mime", "User-Agent": "sros"}
            connection.request("PUT", where, message, headers)
            reply = connection.getresponse()
            if connection.is_cut_off:  # what came may be a part of the answer
                raise TimeoutError(errno.ETIMEDOUT, "it takes too long")
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise UnavailableError(
            what, f"{error}.", ("The agent tries again at its next run.")
        ) from error
    if not 200 <= reply.status < 300:
        raise UnavailableError(
            what, f"It answers {reply.status} to PUT {where}.", "See the log of the server."
        )


def _write(inbox: Path, robot: str, message: bytes) -> None:
    try:
        with Folder(inbox) as folder:
            if not folder.is_folder(robot):
                folder.mkdir(robot, 0o755)
        with staged_file(inbox / robot / MESSAGE_FILE, message, mode=0o644) as put_in_place:
            put_in_place()
    except OSError as error:
        raise UnavailableError(
            f"the message cannot be written into '{inbox}'",
            f"{error.strerror or error}.",
            "The agent tries again at its next run.",
        ) from error

"""Sending a robot's message to its inbox, a web server or a folder."""

from __future__ import annotations

import errno
import http.client
import ssl
from pathlib import Path
from urllib.parse import quote, urlsplit

from sros_tool.agent.connection import (
    REFUSALS,
    GuardedConnection,
    error_clause,
    is_tls_ended_by_server,
)
from sros_tool.agent.fetch import ClientCertificate
from sros_tool.errors import UnavailableError
from sros_tool.files import staged_file
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import MESSAGE_FILE
from sros_tool.wording import capitalized

_NO_UPLOADS = (http.HTTPStatus.METHOD_NOT_ALLOWED, http.HTTPStatus.NOT_IMPLEMENTED)


class RefusedError(UnavailableError):
    """The web server refuses a message, perhaps because it refuses the client's certificate."""


def send(
    inbox: str,
    robot: str,
    message: bytes,
    *,
    client_certificate: ClientCertificate | None = None,
    tls_ca: Path | None = None,
) -> None:
    """Put a message into the inbox, in place of the robot's last message.

    Args:
        inbox: ``https://…``, ``http://…``, or the path of a folder.
        robot: the name of this robot.
        message: the signed message.
        client_certificate: certificate and key for TLS.
        tls_ca: CA certificates (PEM) of the server; None: the CAs of the system.

    Raises:
        UnavailableError: the inbox cannot be reached, or does not take the message; `RefusedError`
        if the inbox seems to refuse the client certificate.
    """
    if not inbox.startswith(("https://", "http://")):
        _write_message(Path(inbox), robot, message)
        return
    failure = f"the inbox {inbox} does not accept the message"
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
            if connection.is_cut_off:  # the answer may be incomplete
                raise TimeoutError(errno.ETIMEDOUT, "it takes too long")
    except (OSError, http.client.HTTPException, ValueError) as error:
        kind = RefusedError if is_tls_ended_by_server(error) else UnavailableError
        why = error_clause(error)
        raise kind(
            failure,
            f"{capitalized(why).removesuffix('.')}.",
            "The agent tries again in its next round.",
        ) from error
    if not 200 <= reply.status < 300:
        kind = RefusedError if reply.status in REFUSALS else UnavailableError
        why = f"The server answers {reply.status} to PUT {where}"
        if reply.status in _NO_UPLOADS:
            raise kind(
                failure,
                f"{why}: it takes no uploads here.",
                "Configure the server as docs/howto/fleet_server.md says, or give `sros agent "
                "init` another --inbox: the URL of another server, or a folder.",
            )
        raise kind(failure, f"{why}.", "See the log of the server.")


def _write_message(inbox: Path, robot: str, message: bytes) -> None:
    try:
        with Folder(inbox) as folder:
            if not folder.is_folder(robot):
                folder.mkdir(robot, 0o755)
        file = inbox / robot / MESSAGE_FILE  # the keystore machine's account has to read it
        with staged_file(file, message, mode=0o644, ignores_umask=True) as put_in_place:
            put_in_place()
    except OSError as error:
        raise UnavailableError(
            f"the message cannot be written into '{inbox}'",
            f"{error.strerror or error}.",
            "The agent tries again in its next round."
            + (
                " If a systemd unit runs the agent, the unit was written before `sros agent "
                "init`, and forbids this: write it again with `sros units KEYSTORE --job agent "
                "FOLDER`."
                if error.errno == errno.EROFS
                else ""
            ),
        ) from error

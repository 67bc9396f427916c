"""Identity certificates from an existing CA service, through a program of the user.

The place ``issuer:NAME`` of an identity CA's key stands for the program ``sros-issuer-NAME`` on the
PATH.  The program gets a request (PKCS#10, PEM) on standard input, and writes the certificate as
PEM to standard output; a chain may follow.  These environment variables say what is requested:
``SROS_ENCLAVE``, ``SROS_SUBJECT`` (RFC 4514), ``SROS_NOT_AFTER`` (ISO 8601, UTC) and
``SROS_KEYSTORE``.

As with ``git-credential-NAME``, a keystore chooses among the programs that the user installed for
this purpose, and cannot contain a program.  The answer of a program is verified before it is
trusted.
"""

from __future__ import annotations

import logging
import os
import re
import select
import shutil
import signal
import subprocess
import tempfile
import time
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.x509.oid import NameOID

from sros_tool.errors import KeystoreError, PkiError, UsageError
from sros_tool.keystore.template import CA_SERVICE_SCHEME, is_ca_service
from sros_tool.pki import tolerant
from sros_tool.pki.certificates import (
    extension,
    issued_by,
    load_certificate,
    other_issuer_text,
    subject_text,
    validity_of,
    weakness,
)
from sros_tool.pki.chains import denies_issuing
from sros_tool.pki.keys import PublicKey, algorithm
from sros_tool.validity import Window, iso

_SERVICE_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,39}", re.ASCII)
_MOST_BYTES = 64 * 1024
_MOST_ERROR_BYTES = 500
_MOST_SECONDS = 60
_POLL_SECONDS = 0.02
"""Seconds between two checks whether a program that closed its output has ended."""
_CLOCK_TOLERANCE = timedelta(hours=1)
"""How long after the start of a keystore's change a certificate may become valid.

A service dates certificates by its own clock, at the time of issuing.
"""
_MOST_SERIAL_BITS = 159
"""Largest serial number, in bits, that a revocation list can have (RFC 5280, 4.1.2.2)."""

_LOG = logging.getLogger(__name__)


class CaServiceError(KeystoreError):
    """The CA service did not issue a certificate, or issued one that cannot be used."""


@dataclass(frozen=True, slots=True)
class CertificateRequest:
    """A request to a CA service: the ``request`` (PEM), and the content that is required.

    If the request is from a robot, ``subject`` may have more parts than the subject in ``request``.
    """

    enclave: str
    request: bytes
    subject: x509.Name
    public_key: PublicKey
    validity: Window


def check_ca_service(place: str) -> None:
    """Raise `UsageError` if ``place`` stands for a CA service with an invalid name."""
    if is_ca_service(place) and not _SERVICE_NAME.fullmatch(place.removeprefix(CA_SERVICE_SCHEME)):
        raise UsageError(
            f"'{place}' is not the name of a CA service",
            "issuer:NAME stands for the program sros-issuer-NAME on the PATH; NAME has lower-case "
            "letters, digits, '-' and '_'.",
        )


@dataclass(frozen=True, slots=True)
class CaService:
    """The CA service that issues the identity certificates of the keystore ``root``.

    ``place`` is ``issuer:NAME``.
    """

    place: str
    root: Path

    @property
    def program(self) -> str:
        """The name of the program that asks the service."""
        return f"sros-issuer-{self.place.removeprefix(CA_SERVICE_SCHEME)}"

    def issue(
        self, request: CertificateRequest, authority: x509.Certificate, now: datetime
    ) -> x509.Certificate:
        """Return the certificate that the service issues; ``authority`` is the identity CA.

        Raises:
            CaServiceError: the program fails, or the certificate is not the requested one.
        """
        answer = self._run_program(request)
        try:
            certificate = load_certificate(answer, f"of {self.program}")
            fault = _certificate_problem(certificate, request, authority, now)
        except PkiError as error:
            fault = error.clause
        if fault:
            raise self._error(request, f"The certificate of `{self.program}` is refused: {fault}")
        _LOG.info("%s issued a certificate for %s", self.program, request.enclave)
        return certificate

    def _run_program(self, asked: CertificateRequest) -> bytes:
        """Run the program, and return its standard output."""
        program = shutil.which(self.program)
        if program is None or not Path(program).is_absolute():
            raise self._error(asked, f"There is no program `{self.program}` on the PATH")
        variables = {
            "SROS_ENCLAVE": asked.enclave,
            "SROS_SUBJECT": subject_text(asked.subject),
            "SROS_NOT_AFTER": iso(asked.validity.not_after),
            "SROS_KEYSTORE": str(self.root.absolute()),
        }
        with tempfile.TemporaryFile() as request:
            request.write(asked.request)
            request.seek(0)
            try:
                process = subprocess.Popen(
                    [program],
                    stdin=request,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    env=os.environ | variables,
                    start_new_session=True,
                )
            except OSError as error:
                why = f"`{self.program}` cannot be started: {error.strerror}"
                raise self._error(asked, why) from error
            answer, errors = _bounded_output(process)
        error_text = " ".join(errors.decode(errors="replace").split())
        if answer is None:
            raise self._error(asked, f"`{self.program}` did not end within {_MOST_SECONDS} seconds")
        if len(answer) > _MOST_BYTES:
            raise self._error(asked, f"`{self.program}` wrote more than {_MOST_BYTES} bytes")
        if process.returncode:
            why = f"`{self.program}` ended with status {process.returncode}"
            raise self._error(asked, f"{why}: {error_text}" if error_text else why)
        return answer

    def _error(self, request: CertificateRequest, why: str) -> CaServiceError:
        return CaServiceError(
            f"the CA service did not issue a certificate for enclave {request.enclave}",
            f"{why}. Nothing was changed.",
        )


def _bounded_output(process: subprocess.Popen[bytes]) -> tuple[bytes | None, bytes]:
    """Return the output of a program, and the end of its error output.

    Reading stops when the output exceeds `_MOST_BYTES`, so that the caller can see this.  The
    output is None if the program does not end in time.  A program that has not ended by itself is
    killed, with its child processes.
    """
    end, answer, errors, ended = time.monotonic() + _MOST_SECONDS, b"", b"", False
    assert process.stdout and process.stderr
    with process.stdout as output, process.stderr as errors_pipe:
        ready = select.poll()
        ready.register(output)
        ready.register(errors_pipe)
        answers = True
        try:
            while len(answer) <= _MOST_BYTES and _seconds_left(end) and not ended:
                for file, _ in ready.poll(_POLL_SECONDS * 1000):
                    part = os.read(file, _MOST_BYTES)
                    if not part:
                        ready.unregister(file)
                        answers = answers and file != output.fileno()
                    elif file == output.fileno():
                        answer += part
                    else:
                        errors = (errors + part)[-_MOST_ERROR_BYTES:]
                ended = not answers and process.poll() is not None
        finally:
            if not ended:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    return answer if ended or len(answer) > _MOST_BYTES else None, errors


def _seconds_left(end: float) -> float:
    return max(0.0, end - time.monotonic())


def _certificate_problem(
    certificate: x509.Certificate,
    request: CertificateRequest,
    authority: x509.Certificate,
    now: datetime,
) -> str:
    """Return why a certificate is not the requested one, as a clause; "" if it is.

    Whether DDS vendors accept it is evaluated later, as for every change of a keystore.
    """
    if tolerant.is_tolerated(certificate):
        return "it breaks rules of X.509 (RFC 5280)"
    key, validity = certificate.public_key(), validity_of(certificate)
    if key != request.public_key:
        return f"it is for another key ({algorithm(key)}) than the request"
    if not issued_by(certificate, authority):
        issuer = other_issuer_text(certificate, authority)
        return f"its issuer is {issuer}, not the identity CA of the keystore"
    subject = {(part.oid, part.value) for part in certificate.subject}
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    if len(names) > 1 or not subject.issuperset((part.oid, part.value) for part in request.subject):
        has, wanted = subject_text(certificate.subject), subject_text(request.subject)
        return (
            f"its subject is {has}; it should be {wanted}, perhaps with more parts. Let the "
            "service take the subject from $SROS_SUBJECT. If the service takes it from the request "
            "of a robot, set certificates.unique_subject to false"
        )
    constraints = extension(certificate, x509.BasicConstraints)
    if (constraints and constraints.ca) or not denies_issuing(certificate):
        return (
            "it is a CA certificate, or could be used as one: it lacks basicConstraints with "
            "CA:FALSE"
        )
    if not (validity.contains(now) or validity.contains(now + _CLOCK_TOLERANCE)):
        return f"it is valid from {iso(validity.not_before)} to {iso(validity.not_after)}, not now"
    if validity.not_after > request.validity.not_after:
        return (
            f"it expires at {iso(validity.not_after)}, later than the requested "
            f"{iso(request.validity.not_after)}"
        )
    if not 0 < certificate.serial_number.bit_length() <= _MOST_SERIAL_BITS:
        return (
            "its serial number is 0 or has more than 159 bits, so that no revocation list can "
            "name the certificate"
        )
    return weakness(certificate)

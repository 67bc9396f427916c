"""What a replaced certificate is still good for, asked of two DDS that enforce security."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.template import load_template
from tests.integration.test_life_on_dds import (
    HEARD,
    LISTENS,
    REFUSED,
    SILENT,
    Ask,
    Question,
    ask,
    copy,
    make,
    permit,
    probe,
)
from tests.support.harness import publish
from tests.support.long_form import some

__all__ = ["ask", "probe"]

pytestmark = pytest.mark.dds


@pytest.mark.parametrize(
    ("revoke_old", "kept", "put_back"),
    some([(False, HEARD, HEARD), (True, SILENT, REFUSED)], 1),
)
def test_the_old_certificate_with_its_old_permissions(
    revoke_old: bool, kept: str, put_back: str, ask: Ask, tmp_path: Path
) -> None:
    """Who keeps the files of before has the rights of before, unless they are revoked.

    Put back beside the new crl.pem, they are refused by the robot's own DDS already.
    """
    root = tmp_path / "ks"
    make(
        root,
        load_template("production"),
        {"/robot": publish("/secret", "/chatter"), "/listener": LISTENS},
    )
    before = copy(root, "before")
    permit(root, {"/robot": publish("/chatter")})
    renew(root, ["/robot", "/listener"], now=datetime.now(UTC), revoke_old=revoke_old)
    after = copy(root, "after")
    for file in ("cert.pem", "key.pem", "permissions.p7s"):
        shutil.copy(enclave_path(before, "/robot") / file, enclave_path(after, "/robot") / file)
    listener = (root, "/listener")
    ask(
        {
            Question((before, "/robot"), listener, "/secret"): kept,
            Question((after, "/robot"), listener, "/secret"): put_back,
            Question((root, "/robot"), listener, "/secret"): REFUSED,
            Question((root, "/robot"), listener, "/chatter"): HEARD,
        }
    )

"""The documents that sros makes are valid by the OMG schemas of 20170901 (rewritten here)."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from lxml import etree

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import render_governance
from sros_tool.dds.permissions import render_permissions
from sros_tool.files import policies_dir
from sros_tool.keystore.template import load_template, template_names
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Enclave
from sros_tool.translate import governance_for, permissions_for
from sros_tool.validity import Window

NOW = datetime(2024, 2, 29, 23, 59, 59, tzinfo=UTC)
DOMAINS = DomainSet.parse("0,7,10-19")
ENCLAVES = [
    enclave
    for path in sorted((*policies_dir().glob("*.xml"), *policies_dir().glob("defaults/*.xml")))
    for enclave in read_policy(path).enclaves
]


def schema(name: str) -> etree.XMLSchema:
    path = Path(__file__).with_name("schemas") / f"{name}.xsd"
    return etree.XMLSchema(etree.parse(path, etree.XMLParser(no_network=True)))


PERMISSIONS, GOVERNANCE = schema("dds_permissions"), schema("dds_governance")


def permissions_document(enclave: Enclave) -> bytes:
    return render_permissions(
        permissions_for(
            enclave,
            subject=f"CN={enclave.path}",
            validity=Window(NOW, NOW + timedelta(days=1)),
            domains=DOMAINS,
        )
    )


@pytest.mark.parametrize("enclave", ENCLAVES, ids=lambda enclave: enclave.source)
def test_permissions(enclave: Enclave) -> None:
    PERMISSIONS.assertValid(etree.fromstring(permissions_document(enclave)))


@pytest.mark.parametrize("name", template_names())
def test_governance(name: str) -> None:
    document = render_governance(governance_for(load_template(name).protection, DOMAINS))
    GOVERNANCE.assertValid(etree.fromstring(document))


RULE = "<domains><id>0</id></domains>"
PUBLISH = "<publish><topics><topic>rt/a</topic></topics></publish>"
SUBSCRIBE = PUBLISH.replace("publish", "subscribe")
DATES = "<not_before>2024-01-01T00:00:00Z</not_before><not_after>2034-01-01T00:00:00</not_after>"


def grant(
    rules: str = f"<allow_rule>{RULE}{PUBLISH}</allow_rule>",
    *,
    name: str = "name='g'",
    dates: str = DATES,
    default: str = "<default>DENY</default>",
) -> str:
    return (
        f"<dds><permissions><grant {name}><subject_name>CN=/a</subject_name>"
        f"<validity>{dates}</validity>{rules}{default}</grant></permissions></dds>"
    )


def allow(content: str) -> str:
    return grant(f"<allow_rule>{content}</allow_rule>")


@pytest.mark.parametrize(
    ("valid", "document"),
    [
        (True, grant()),
        (True, grant(f"<deny_rule>{RULE}</deny_rule><allow_rule>{RULE}{PUBLISH}</allow_rule>" * 2)),
        (True, allow(RULE + PUBLISH + SUBSCRIBE)),
        (True, allow(RULE + PUBLISH + PUBLISH)),
        (True, allow("<domains><id_range><min>1</min></id_range></domains>")),
        (True, allow("<domains><id_range><max>1</max></id_range><id>7</id></domains>")),
        (
            True,
            allow(
                RULE
                + PUBLISH.replace(
                    "</topics>", "</topics><partitions><partition>p</partition></partitions>"
                )
            ),
        ),
        (False, grant("")),
        (False, grant(name="")),
        (False, grant(default="")),
        (False, grant(default="<default>allow</default>")),
        (False, grant(dates="<not_before>2024-01-01</not_before><not_after>x</not_after>")),
        (False, grant(dates="<not_after>2034-01-01T00:00:00</not_after>")),
        (False, allow(RULE + SUBSCRIBE + PUBLISH)),
        (False, allow(PUBLISH + RULE)),
        (False, allow(PUBLISH)),
        (False, allow("<domains/>")),
        (False, allow("<domains><id>-1</id></domains>")),
        (False, allow("<domains><id_range/></domains>")),
        (False, allow(RULE + "<publish><topics/></publish>")),
        (False, allow(RULE + "<publish/>")),
        (False, allow(RULE + "<write/>")),
        (False, "<dds><permissions/></dds>"),
    ],
)
def test_what_the_schema_of_permissions_tells_apart(valid: bool, document: str) -> None:
    assert PERMISSIONS.validate(etree.fromstring(document)) is valid, PERMISSIONS.error_log


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<topic_expression>*</topic_expression>", ""),
        ("<rtps_protection_kind>SIGN<", "<rtps_protection_kind>sign<"),
        (
            "<data_protection_kind>ENCRYPT<",
            "<data_protection_kind>SIGN_WITH_ORIGIN_AUTHENTICATION<",
        ),
        ("<enable_join_access_control>true<", "<enable_join_access_control>yes<"),
        ("<domains>", "<domains><id>all</id>"),
        ("<topic_access_rules>", "<topic_access_rules><rule/>"),
    ],
)
def test_what_the_schema_of_governance_refuses(old: str, new: str) -> None:
    protection = load_template("development").protection
    document = render_governance(governance_for(protection, DOMAINS)).decode()
    assert old in document
    broken = document.replace(old, new, 1).encode()
    assert not GOVERNANCE.validate(etree.fromstring(broken))

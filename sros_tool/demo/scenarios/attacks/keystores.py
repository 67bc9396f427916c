"""Attacks that are tried only in a keystore of the user: by its enclaves that stand out."""

from __future__ import annotations

from sros_tool.demo.scenarios.attacks.kinds import (
    calling,
    discovering,
    injection,
    listening,
    posing_as_server,
)
from sros_tool.demo.scenarios.model import OWN, Identity, Row, RowStatus

WIDEST_PUBLISHER, WIDEST_SUBSCRIBER = "widest publisher", "widest subscriber"
WIDEST_CLIENT, WIDEST_SERVER = "widest client", "widest server"

WIDEST: dict[str, Row] = {
    WIDEST_PUBLISHER: injection(
        "the widest enclave publishes a topic that it was not given",
        Identity(OWN, WIDEST_PUBLISHER),
        RowStatus.REFUSED,
        "its signed permissions do not allow the topic",
        attack="an enclave publishes a topic",
    ),
    WIDEST_SUBSCRIBER: listening(
        "the widest enclave hears a topic that it was not given",
        Identity(OWN, WIDEST_SUBSCRIBER),
        RowStatus.REFUSED,
        "its signed permissions do not allow the topic",
        attack="an enclave hears a topic",
    ),
    WIDEST_CLIENT: calling(
        "the widest enclave calls a service that it was not given",
        Identity(OWN, WIDEST_CLIENT),
        RowStatus.REFUSED,
        "its signed permissions allow neither the request nor the reply",
        attack="an enclave calls a service",
    ),
    WIDEST_SERVER: posing_as_server(
        "the widest enclave poses as the server",
        Identity(OWN, WIDEST_SERVER),
        RowStatus.REFUSED,
        "its signed permissions do not allow replies",
        attack="a client poses as the server",
    ),
}
"""The attack of the enclave with the widest permissions, by its part."""


def joining(enclave: str, fault: str) -> Row:
    """Return a row that shows whether an enclave with a ``fault`` in its files joins the others."""
    return _joining(f"{enclave} joins the other enclaves", enclave, RowStatus.VISIBLE, fault)


def revoked_joining(enclave: str, own: bool) -> Row:
    """Return a row that shows whether a revoked enclave joins the others.

    ``own`` says whether the enclave itself has the list that revokes it.
    """
    expected = RowStatus.NOT_LET_IN if own else RowStatus.NOT_VISIBLE
    mechanism = "the revocation list of the keystore names its certificate"
    return _joining(f"{enclave}, revoked, joins the other enclaves", enclave, expected, mechanism)


def _joining(name: str, enclave: str, expected: RowStatus, mechanism: str) -> Row:
    """Return a row in which an enclave looks for the talker.

    Endpoints are announced to whom the talker's DDS has authenticated, and to nobody else.
    """
    return discovering(name, Identity(OWN, enclave), expected, mechanism, attack="")

"""Kinds of findings about an update to another ROS 2 distribution; `sros_tool.proof` makes them.

Some kinds are for a keystore of several distributions: an access is allowed on one distribution and
denied on another.
"""

from __future__ import annotations

from sros_tool.checks.kind import ERROR, NOTE, WARNING, FindingKind

_ENGINE_SOURCE = (
    "sros: its decision engine, with the rules of the DDS that each distribution ships."
)
_DECIDE_ALIKE_REMEDY = (
    "`sros explain KEYSTORE ENCLAVE ... --all-distros` shows the rule that decides for each "
    "distribution. Remove deny rules for names that no rule allows, and sign the rights in the "
    "form that sros writes: `sros create_permission KEYSTORE ENCLAVE POLICY_FILE`."
)

OPENS = FindingKind(
    "upgrade.opens",
    ERROR,
    "an access that is closed now and open after the update",
    "The same signed permissions let the enclave do more with the DDS of the other distribution. "
    "Nothing fails, so nobody notices.",
    _ENGINE_SOURCE,
    _DECIDE_ALIKE_REMEDY,
)
CLOSES = FindingKind(
    "upgrade.closes",
    ERROR,
    "an access that is open now and closed after the update",
    "The same signed permissions let the enclave do less with the DDS of the other distribution: "
    "its nodes fail when they create the endpoint, or their messages do not arrive.",
    _ENGINE_SOURCE,
    _DECIDE_ALIKE_REMEDY,
)
REFUSED = FindingKind(
    "upgrade.refused",
    ERROR,
    "an enclave that runs now and is refused after the update",
    "The DDS of the other distribution does not accept a file of the enclave, or other enclaves "
    "refuse its nodes.",
    _ENGINE_SOURCE,
    "Before the update, replace the refused files, which `sros check KEYSTORE --all-distros` "
    "names.",
)
ACCEPTED = FindingKind(
    "upgrade.accepted",
    WARNING,
    "an enclave that is refused now and runs after the update",
    "The DDS of the other distribution accepts a file that is refused now, such as expired "
    "permissions: the enclave can join again.",
    _ENGINE_SOURCE,
    "If the enclave must stay out, revoke it with `sros revoke KEYSTORE ENCLAVE`. Otherwise "
    "replace the refused file, so that both distributions accept it.",
)
NO_NODE = FindingKind(
    "upgrade.node-cannot-start",
    ERROR,
    "permissions with which no ordinary node starts after the update",
    "When a node starts, it creates the endpoints that the finding names, and exits if one of "
    "them is denied. Nodes of Iron and later also offer ~/get_type_description.",
    "ROS 2 Jazzy, rcl 9, rclcpp 28, rclpy 7 and rmw_dds_common; REP-2016.",
    "Include common/node.xml in the profiles of the enclave's nodes (`sros check POLICY_FILE` says "
    "how), and sign the policy with `sros generate_artifacts -k KEYSTORE -p POLICY_FILE`.",
)
BUFFERS = FindingKind(
    "upgrade.zenoh-buffers",
    WARNING,
    "Zenoh files that lack the Zenoh keys (names) on which rmw_zenoh sends images after the update",
    "rmw_zenoh of Lyrical sends messages with arrays of bytes, such as images and point clouds, "
    "on Zenoh keys (names) below the key of the topic. With files of an earlier sros, Zenoh "
    "drops these messages without a log line.",
    "ros2/rmw_zenoh, rmw_publisher_data.cpp.",
    "Write the files again with `sros zenoh KEYSTORE`, and deliver them before the update.",
)
ZENOH = FindingKind(
    "upgrade.zenoh-release",
    NOTE,
    "a different release of rmw_zenoh",
    "The files that sros writes work with all supported releases, from the named version on.",
    "ros2/rmw_zenoh, its changelogs.",
    "Install at least that version on every robot.",
)
VULNERABILITIES = FindingKind(
    "upgrade.vulnerabilities",
    NOTE,
    "known vulnerabilities that the update fixes or brings",
    "sros compares the latest DDS releases that the two distributions ship; `sros check runtime` "
    "examines the libraries that processes have loaded.",
    "Advisories in the OSV format, which ship with sros or are in --advisories FILE.",
    "Take new vulnerabilities into account before the update. Against vulnerabilities that no "
    "release fixes, keep strangers out of the network.",
    prominent=True,
)
EXPIRED_PEERS = FindingKind(
    "upgrade.expired-peers",
    NOTE,
    "a different effect of an expired certificate on running processes",
    "With one release, running processes lose each other when the certificate of one of them "
    "expires. With the other release, they keep communicating until they restart.",
    "sros: measured with the named releases; CVE-2025-67108.",
    "Renew in time, and restart: `sros check KEYSTORE --needs-renewal 30d` says what is due. To "
    "stop an enclave, revoke it; do not wait until it expires.",
    prominent=True,
)
NOT_MEASURED = FindingKind(
    "distribution.not-measured",
    NOTE,
    "a release of a DDS that sros was not tested with",
    "sros decides by the rules of another release of this product, so it does not see differences "
    "between the two releases.",
    _ENGINE_SOURCE,
    "Try the update on one robot, and look at its logs with `sros explain KEYSTORE --log FILE`.",
    prominent=True,
)
DIFFER = FindingKind(
    "distribution.differ",
    ERROR,
    "an access that is open on one distribution of the keystore and closed on another",
    "The settings of the keystore, or its fleet file, name both distributions. The same signed "
    "permissions give an enclave more rights on one of them.",
    _ENGINE_SOURCE,
    _DECIDE_ALIKE_REMEDY,
)
DISTRIBUTION_REFUSES = FindingKind(
    "distribution.refused",
    ERROR,
    "an enclave that runs on one distribution of the keystore and not on another",
    "The settings of the keystore, or its fleet file, name both distributions.",
    _ENGINE_SOURCE,
    "Replace the refused file, or correct `distributions` in the settings of the keystore: `sros "
    "update_keystore KEYSTORE --set distributions=NAME,...`.",
)

OF_ENCLAVES = (OPENS, CLOSES, REFUSED, ACCEPTED, NO_NODE, DIFFER, DISTRIBUTION_REFUSES)
"""The kinds of findings about single enclaves."""

ALL = (
    *(OPENS, CLOSES, REFUSED, ACCEPTED, NO_NODE, BUFFERS, ZENOH, VULNERABILITIES),
    *(EXPIRED_PEERS, NOT_MEASURED, DIFFER, DISTRIBUTION_REFUSES),
)
"""All kinds of this module, the kinds about an update first."""

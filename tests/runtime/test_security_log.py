"""What the vendors say, as measured and as in their sources."""

from __future__ import annotations

import pytest

from sros_tool.runtime.security_log import endpoint_refusal, missing_security, participant_refusal

ENDPOINT = [
    "\x1b[37;1m2026-01-01 12:00:00.000 [\x1b[31;1mSECURITY Error\x1b[37;1m] \x1b[0mrt/chatter topic"
    " not found in allow rule. (/x/Permissions.cpp:1246) -> Function check_create_datareader",
    "[SECURITY Error] rt/chatter topic denied by deny rule. -> Function check_rule",
    "[SECURITY Error] Not found topic access rule for topic ros_discovery_info",
    "cannot create topic rt/chatter. Not Allowed By Security",
    "1795242829.9 [121] python: Local topic permission denied: rt/x denied by default rule(145)",
]
PARTICIPANT = [
    "[SECURITY Error]  -> Function validate_local_identity",
    "[SECURITY Error] Error verifying private key",
    "[SECURITY Error] PKCS7 data verification failed",
    "[SECURITY Error] Not found the identity subject name in permissions file",
    "Error occurred while validating local permissions: Subject name is invalid(code: 146)",
    "Error occurred while validating local permission: Certificate not valid (code: 200)",
]
NEITHER = [
    "",
    "Segmentation fault",
    "RCLError: invalid allocator",
    "[RTPS_TRANSPORT_SHM Error] Failed init_port",
    "[INFO] [rcl]: Found security directory: /k/enclaves/talker",
    "ModuleNotFoundError: No module named 'std_msgs'",
]


@pytest.mark.parametrize("line", ENDPOINT)
def test_endpoint_refusals(line: str) -> None:
    found = endpoint_refusal(f"before\n{line}\nafter")
    assert found
    assert "\x1b" not in found
    assert not missing_security(line)


@pytest.mark.parametrize("line", PARTICIPANT)
def test_participant_refusals(line: str) -> None:
    assert participant_refusal(f"before\n{line}\nafter") == " ".join(line.split())
    assert not endpoint_refusal(line)


@pytest.mark.parametrize("line", NEITHER)
def test_what_is_no_refusal(line: str) -> None:
    assert not endpoint_refusal(line)
    assert not participant_refusal(line)
    assert not missing_security(line)


def test_security_that_is_not_built_in() -> None:
    assert missing_security("This Fast DDS version doesn't have the security libraries")

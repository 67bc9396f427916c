"""What the vendors say, as tested and as in their sources."""

from __future__ import annotations

import pytest

from sros_tool.runtime.vendor_log import (
    endpoint_refusal,
    log_lines,
    missing_security,
    participant_refusal,
    plain_refusal,
)

TIME = "\x1b[37;1m2026-01-01 12:00:00.000 [\x1b[31;1mSECURITY Error\x1b[37;1m] \x1b[0m"

ENDPOINT = {
    f"{TIME}rt/chatter topic not found in allow rule. (/x/Permissions.cpp:1246) -> Function "
    "check_create_datareader": "rt/chatter topic not found in allow rule.",
    f"{TIME}Error checking creation of local writer 1.2|0 (rt/x topic not found in allow rule. "
    "(/x/Permissions.cpp:1192))":
        "Error checking creation of local writer 1.2|0 (rt/x topic not found in allow rule.)",
    "[SECURITY Error] rt/chatter topic denied by deny rule. -> Function check_rule":
        "rt/chatter topic denied by deny rule.",
    "[SECURITY Error] Not found topic access rule for topic ros_discovery_info":
        "Not found topic access rule for topic ros_discovery_info",
    "1795309235.50 [EMERGENCY] 01.0f|0.0.1.c1 0 Permissions::check_create_datawriter : "
    "rt/x topic not found in allow rule.": "rt/x topic not found in allow rule.",
    "cannot create topic rt/chatter. Not Allowed By Security":
        "cannot create topic rt/chatter. Not Allowed By Security",
    "1795242829.9 [121] python: Local topic permission denied: rt/x denied by default rule(145)":
        "Local topic permission denied: rt/x denied by default rule(145)",
}  # fmt: skip
PARTICIPANT = {
    f"{TIME} -> Function validate_local_identity":
        "validate local identity failed, and Fast DDS gives no reason",
    "1795309235.50 [EMERGENCY] 01.0f|0.0.1.c1 0 PKIDH::validate_local_identity : ":
        "validate local identity failed, and Fast DDS gives no reason",
    f"{TIME}Error verifying private key /k/key.pem (/x/FileProvider.cpp:242) -> Function "
    "validate_local_identity": "Error verifying private key /k/key.pem",
    "[SECURITY Error] PKCS7 data verification failed": "PKCS7 data verification failed",
    "[SECURITY Error] Not found the identity subject name in permissions file":
        "Not found the identity subject name in permissions file",
    "Error occurred while validating local permissions: Subject name is invalid(code: 146)":
        "Error occurred while validating local permissions: Subject name is invalid(code: 146)",
    "Error occurred while validating local permission: Certificate not valid (code: 200)":
        "Error occurred while validating local permission: Certificate not valid (code: 200)",
}  # fmt: skip
NEITHER = [
    "",
    "Segmentation fault",
    "RCLError: invalid allocator",
    "[RTPS_TRANSPORT_SHM Error] Failed init_port",
    "[INFO] [rcl]: Found security directory: /k/enclaves/talker",
    "ModuleNotFoundError: No module named 'std_msgs'",
]


@pytest.mark.parametrize(("line", "words"), ENDPOINT.items())
def test_endpoint_refusals(line: str, words: str) -> None:
    assert endpoint_refusal(f"before\n{line}\nafter") == words == plain_refusal(line)
    assert not missing_security(line)


@pytest.mark.parametrize(("line", "words"), PARTICIPANT.items())
def test_participant_refusals(line: str, words: str) -> None:
    assert participant_refusal(f"before\n{line}\nafter") == words == plain_refusal(line)
    assert not endpoint_refusal(line)


@pytest.mark.parametrize("line", NEITHER)
def test_what_is_no_refusal(line: str) -> None:
    assert not endpoint_refusal(line)
    assert not participant_refusal(line)
    assert not missing_security(line)


def test_security_that_is_not_built_in() -> None:
    assert missing_security("This Fast DDS version doesn't have the security libraries")
    assert missing_security("the Cyclone DDS being used does not have security support enabled.")


def test_no_process_puts_a_line_of_another_one_into_a_log() -> None:
    """Behind another line separator, a label would make the text that of another process."""
    line = "[a-1] one\r[b-2] two\x0b[b-2] three\x85[b-2] four\u2028[b-2] five"
    assert log_lines(f"{line}\r\n[b-2] own\n") == [line, "[b-2] own", ""]

"""The filter that collects the signing requests of robots, of which each chose its own."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from ansible.errors import AnsibleFilterError

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.plugin_utils.facts import check_facts

DOCUMENTATION = r"""
name: made_requests
short_description: The signing requests that robots made
description:
  - Returns the signing request of each enclave in C(sros_own_keys) of a robot, from what the module
    M(sros.fleet.requests) returned as C(sros_requests).
  - A robot that returned anything else is refused by name. Which enclave a request is really for
    is left to C(sros sign_request --enclave).
  - A robot with C(sros_refused) is left out.
options:
  _input:
    description: The variables of all robots (C(hostvars)).
    type: dict
    required: true
author:
  - The authors of sros
"""

EXAMPLES = r"""
made: "{{ hostvars | sros.fleet.made_requests }}"
"""

RETURN = r"""
_value:
  description: The C(enclave) and the C(request) (PEM) of each.
  type: list
  elements: dict
"""

_LONGEST = 20_000
_REQUEST = re.compile(
    r"\s*-----BEGIN CERTIFICATE REQUEST-----[A-Za-z0-9+/=\s]+-----END CERTIFICATE REQUEST-----\s*"
)


def made_requests(hosts: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the enclave and the request of each key that was made on a robot."""
    found = []
    for host in sorted(hosts):
        variables = hosts[host]
        returned = variables.get("sros_requests")
        if not isinstance(returned, Mapping) or "requests" not in returned:
            continue  # nobody asked this robot
        if variables.get("sros_refused"):
            continue
        try:
            check_facts(variables)
        except RefusedError as error:
            raise AnsibleFilterError(f"{host}: {error}") from error
        made, own = returned["requests"], variables.get("sros_own_keys") or []
        if not isinstance(made, Mapping) or not set(made) <= set(own):
            raise AnsibleFilterError(
                f"{host} returned requests for other enclaves than those in its sros_own_keys."
                " Nothing was signed for it. Look at that robot."
            )
        for enclave, request in sorted(made.items()):
            text = str(request)
            if len(text) > _LONGEST or not _REQUEST.fullmatch(text):
                raise AnsibleFilterError(
                    f"{host} returned something else than one signing request for {enclave}."
                    " Nothing was signed for it. Look at that robot."
                )
            found.append({"enclave": str(enclave), "request": text.strip()})
    return found


class FilterModule:
    """The filters of this file."""

    def filters(self) -> dict[str, Any]:
        """Return the filters by their names."""
        return {"made_requests": made_requests}

"""Translation of Zenoh's keys and access control back to ROS terms: what rules allow whom.

The third translation next to `translate` and `translate_zenoh`, for rules that others wrote.
"""

from __future__ import annotations

_HISTORY = "/@adv"
_OF_TYPE = 2
"""The type and its hash, with which the keys of topics and services end."""


def name_of_key(key: str) -> tuple[str, str]:
    """Return the domain and the ROS name in a key or key expression of rmw_zenoh.

    The name is "" for the graph, and for what is no key of a topic or a service.
    """
    domain, _, rest = key.partition("/")
    chunks = rest.partition(_HISTORY)[0].split("/")
    if domain.startswith("@") or len(chunks) <= _OF_TYPE:
        return domain, ""
    return domain, "/" + "/".join(chunks[:-_OF_TYPE])

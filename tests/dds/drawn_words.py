"""The names, expressions, zones and oddities of which documents are drawn."""

from __future__ import annotations

SUBJECTS = (
    "CN=/t",
    "CN=/t/u",
    "CN=/robot,O=x",
    "CN=/t,OU=5f3a",
    "CN=plain",
    "CN=/t,OU=y+O=x",
    "street=s,CN=/t",
)
"""Every subject that is drawn, for identities that are made once, as OpenSSL prints them."""

ZONES = ("UTC", "America/Los_Angeles", "Asia/Tokyo", "Europe/Berlin", "Asia/Kolkata")
DOMAINS = (42, 0, 7, 41, 200)
TOPICS = (
    "rt/a",
    "rt/b",
    "rt/c",
    "rt/s",
    "rt/a/b",
    "rt/ab",
    "rt/a1",
    "rq/aRequest",
    "rr/aReply",
    "ros_discovery_info",
)
ODD_TOPICS = (
    "rt/b-x",
    "*",
    "rt/*",
    "rt/a?",
    "rt/[ab]",
    "rt/[z-",
    *(f"rt/{'n' * n}" for n in (248, 249)),
)
WILDCARDS = (
    "*",
    "rt/*",
    "*a*",
    "rt/?",
    "rt/a*",
    "r?/a*",
    "rt/*/b",
    "rt/**",
    "rq/*Request",
)
SETS = (
    "rt/[a-c]",
    "rt/[!a]",
    "rt/[^a]",
    "rt/a[[:digit:]]",
    "rt/[ab]",
    "rt/[ab]-x",
    "rt/[abc",
    "rt/[a-]*",
    "rt[/]a",
    "rt/[]a]",
    "rt/[z-",
    "rt/[!a-",
    "rt/[[.a.]b]",
    "rt/[[=a=]c]",
)
PARTITIONS = ("p1", "p2", "q")
PARTITION_EXPRESSIONS = ("p1", "p2", "p*", "*", "", "[pq]?")
NEAR = (-20, -12, -10, -8, -6, -4, -1, 0, 2, 5, 7, 9, 11, 14)
"""Hours from now, so few that zones matter."""

ODDITIES = (
    "comment",
    "comment behind permissions",
    "comment behind domain_access_rules",
    "governance order",
    "missing kind",
    "unknown in governance",
    "no topic rules",
    "TRUE",
    "spaced flag",
    "spaced governance",
    "no default",
    "empty default",
    "spaced default",
    "default first",
    "validity first",
    "unknown in grant",
    "unknown behind default",
    "no name",
    "attribute",
    "spaced subject",
    "date only",
    "end without time",
    "far end",
    "fraction",
    "short date",
    "spaced date",
    "no domains",
    "unknown in rule",
    "empty criteria",
    "capitals",
    "two topics lists",
    "empty topics list",
    "empty topic",
    "unknown in criteria",
    "data tags",
    "empty partitions",
    "spaced topic",
    "max only",
    "big max",
    "hexadecimal",
    "empty id",
    "wide id",
    "spaced id",
)
"""Over which parsers differ; a document has one at most."""

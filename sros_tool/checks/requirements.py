"""Kinds of findings about requirements; `sros_tool.proof` decides them."""

from __future__ import annotations

from sros_tool.checks.kind import ERROR, NOTE, WARNING, FindingKind

VIOLATED = FindingKind(
    "requirement.violated",
    ERROR,
    "a requirement that does not hold",
    "The policy or keystore allows access that the requirements file forbids, or denies access "
    "that it demands. All names that a process could use count, not only the names in use today.",
    "The requirements file.",
    "Change the policy at the named lines, or change the requirement.",
)
VACUOUS = FindingKind(
    "requirement.vacuous",
    WARNING,
    "a requirement that protects less than it states",
    "The part that the finding names protects nothing: perhaps a name is misspelled or was "
    "changed, or the exceptions cover every enclave.",
    "The requirements file.",
    "Correct the name, its kind (service or action) or the exceptions. After `merge_policy "
    "--remap`, check with the same --remap. For a name that is to stay unused, write [[nobody]].",
)
UNKNOWN_ENCLAVE = FindingKind(
    "requirement.unknown-enclave",
    NOTE,
    "a requirement with an exception for an enclave that does not exist",
    "The exception has no effect. Perhaps the enclave is only on other robots, or its name is "
    "misspelled.",
    "The requirements file.",
    "Compare the name with the names of the robot's enclaves; ignore this finding if only other "
    "robots, or robots of a package's users, have the enclave.",
    prominent=True,
)
MISSPELLED_ENCLAVE = FindingKind(
    "requirement.misspelled-enclave",
    WARNING,
    "a requirement with an exception for an enclave whose name is probably misspelled",
    "No enclave has this name, but an enclave has almost the same name. The requirement makes no "
    "exception for that enclave.",
    "The requirements file.",
    "Correct the name in the requirement. If both enclaves are meant, and only other robots have "
    "the missing one, leave this finding out: `--exclude requirement.misspelled-enclave`.",
)
ALLOWED_BY_NAME = FindingKind(
    "requirement.allowed-by-name",
    NOTE,
    "access that a requirement allows to every enclave with such a name",
    "Only the pattern allows this: the list does not name these enclaves. Enclaves of any package "
    "can have a name that the pattern matches.",
    "The requirements file.",
    "If these enclaves are meant, ignore this finding. Otherwise, replace the pattern by the names "
    "of the enclaves that are meant (for requirements of a package, in a copy): `//operator/panel` "
    "is only /operator/panel, whatever the namespace.",
    prominent=True,
)
UNNAMED = FindingKind(
    "requirement.unnamed",
    NOTE,
    "a requirement about a name that no right states",
    "No right has exactly this name; a wildcard may match it. Either the name is misspelled, or "
    "it is meant to stay unused.",
    "The requirements file.",
    "Compare the name with the robot's names; ignore this finding if the name is meant to stay "
    "unused.",
    prominent=True,
)
DROPPED = FindingKind(
    "requirement.dropped",
    ERROR,
    "a requirement that was removed or weakened",
    "The earlier requirements file was stricter: a policy can now allow access that the "
    "requirement "
    "forbade, without a finding.",
    "The requirements file, and the one given as --requirements-before.",
    "Restore the requirement, or approve its removal in the review (`--dropped-requirements "
    "allow`).",
)
ASSUMED = FindingKind(
    "requirement.assumed",
    NOTE,
    "a protection that the policy does not state",
    "The requirement holds only with the protection of the default template. A policy has no "
    "governance, and a keystore's template can protect less.",
    "The requirements file.",
    'Name the keystore\'s template with --template, write <?sros protect="..."?> directly '
    "after the name in the policy, before its end tag, or check the keystore.",
    prominent=True,
)
HOLDS_ALONE = FindingKind(
    "requirement.holds-alone",
    NOTE,
    "a requirement that only further enclaves could break",
    "None of the enclaves here can break the requirement, or at least a part of it. Or none of "
    "them has the other side of a name in it, such as the server of a called service. For a "
    "package, this is normal: the enclaves of its users could break the requirement.",
    "The requirements file.",
    "For the policy of a package, also check a robot with further enclaves: `sros check "
    "ROBOT_POLICY --requirements FILE --namespace NS`. For the policy of a whole robot, add "
    "`--namespace /` to be warned of names that were probably changed.",
    prominent=True,
)
NOT_CROSSING = FindingKind(
    "requirement.not-crossing",
    NOTE,
    "a required right whose data does not pass between Zenoh routers",
    "The enclave has the right, and an enclave at another router has the counterpart right, but "
    "the routers do not forward the name to each other.",
    "The requirements file, and the router.json5 of both routers.",
    "Add the name to `crossing` in the keystore's settings, or ignore this if the name is used "
    "on one robot only.",
    prominent=True,
)
OF_EXPORT = FindingKind(
    "requirement.of-export",
    NOTE,
    "requirements that were checked for the enclaves of an export only",
    "An export may lack enclaves of its keystore. A laptop or another computer can have an enclave "
    "that breaks a requirement.",
    "The requirements file.",
    "Check the keystore that the export comes from.",
    prominent=True,
)
ROBOTS_LEFT_OUT = FindingKind(
    "requirement.robots-left-out",
    NOTE,
    "requirements were not checked for some robots of the fleet",
    "The requirements were checked only in the named namespaces; these robots have other "
    "namespaces.",
    "The fleet file.",
    "Name their namespaces, too, with --namespace, or ignore this if the requirements are not for "
    "these robots.",
    prominent=True,
)
REMAPPING_UNUSED = FindingKind(
    "requirement.remapping-unused",
    NOTE,
    "a remapping that changes no requirement",
    "The policy has the new name or node, but requirements have only a name that is similar to the "
    "old name, or another remapping gives the old name another new name. If the remapping "
    "misspells the old name, requirements on the correct name do not move to the new name.",
    "The requirements file.",
    "Compare the old name with the names in the requirements; leave out the --remap if no "
    "requirement should have the old name, or if the other --remap is right.",
    prominent=True,
)
NOT_ON_ZENOH = FindingKind(
    "requirement.not-on-zenoh",
    NOTE,
    "requirements were not checked for Zenoh",
    "The policy cannot be translated to Zenoh, or the export lacks the router.json5, which shows "
    "what Zenoh enforces. So the access on Zenoh is not known: a requirement may be broken there.",
    "zenoh.io, Access Control.",
    "Ignore this if the robot uses DDS. Otherwise, change the policy; for an export, check the "
    "keystore that it comes from.",
    prominent=True,
)

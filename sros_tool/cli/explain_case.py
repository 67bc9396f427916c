"""Of what, where and when ``sros explain`` is asked: its words and options as values."""

from __future__ import annotations

import os
from datetime import tzinfo
from pathlib import Path
from typing import TYPE_CHECKING

from sros_tool.cli.common import domain_of, keystore_from_environment, moment_of, ros_domain
from sros_tool.errors import KeystoreError

if TYPE_CHECKING:
    from sros_tool.dds.decision import Vendor
    from sros_tool.dds.domains import DomainSet
    from sros_tool.explain.answer import Setting
    from sros_tool.explain.case import Case
    from sros_tool.explain.material import Material
    from sros_tool.policy.model import Enclave


class Place:
    """The options that say where and when."""

    def __init__(self, moment: str | None, domain: str | None, zone: str | None) -> None:
        self.at = moment_of(moment)
        self._domain = ros_domain() if domain is None else domain_of(domain)
        self._zone = _zone(zone)

    def setting(self, domains: DomainSet | None) -> Setting:
        """Where a question is asked of an enclave that is made for these domains."""
        from sros_tool.explain.answer import Setting
        from sros_tool.runtime.environment import choose_domain

        chosen = self._domain
        if chosen is None:
            chosen = choose_domain(domains, None, Path()) if domains else 0
        return Setting(chosen, self.at, self._zone)


def _zone(name: str | None) -> tzinfo:
    from sros_tool.cli.zone import local_zone, named_zone

    return local_zone(os.environ) if name is None else named_zone(name)


def case_of(root: Path | None, enclave: str, policy: Path | None, place: Place) -> Case:
    """What is asked: the enclave of a keystore, of a folder, or of a policy alone."""
    from sros_tool.explain.case import Case

    stated = _stated(policy, enclave)
    if root is None and not policy and not _is_enclave(Path(enclave)):
        root = keystore_from_environment()
    material = signed_material(root, enclave, place, planned=stated is not None)
    if material is None:
        assert stated is not None
        material = _planned(stated, root, place)
    elif stated is None and policy:
        stated = _stated(policy, material.enclave)
    return Case(material, place.setting(material.domains), root, stated)


def _stated(policy: Path | None, enclave: str) -> Enclave | None:
    """What the policy file says of the enclave, where there is a file."""
    from sros_tool.errors import PolicyError
    from sros_tool.policy.reader import read_policy

    if policy is None:
        return None
    read = read_policy(policy)
    found = read.enclave(enclave)
    if found is None and not _is_enclave(Path(enclave)):
        there = ", ".join(each.path for each in read.enclaves)
        raise PolicyError(
            f"unable to find enclave {enclave} in the policy '{policy}'", f"It has {there}."
        )
    return found


def signed_material(
    root: Path | None, name: str, place: Place, *, planned: bool = False
) -> Material | None:
    """What is signed for an enclave of a keystore, or in a folder of that name.

    None if there is neither keystore nor folder, or, with ``planned``, no such enclave yet.
    """
    from sros_tool.explain.material import from_folder
    from sros_tool.keystore.create import list_enclaves
    from sros_tool.keystore.enclave import enclave_path
    from sros_tool.keystore.missing import no_such_enclave

    if root is None:
        folder = Path(name)
        if not _is_enclave(folder):
            return None
        return from_folder(_name_of(folder, place), folder, at=place.at)
    if _is_enclave(root) and not (root / "enclaves").is_dir():
        own = _name_of(root, place)
        if own != name:
            raise KeystoreError(f"'{root}' is the folder of {own or 'no enclave'}, not of {name}")
        return from_folder(own, root, at=place.at)
    names = list_enclaves(root)
    if name in names:
        return from_folder(name, enclave_path(root, name), at=place.at)
    if planned:
        return None
    raise no_such_enclave(root, name, names)


def _is_enclave(folder: Path) -> bool:
    return any((folder / name).exists() for name in ("cert.pem", "permissions.p7s"))


def _name_of(folder: Path, place: Place) -> str:
    """The name of the enclave whose folder this is: the common name of its certificate."""
    from sros_tool.keystore.verify import check_enclave
    from sros_tool.pki.certificates import common_name_of

    certificate = check_enclave(folder, now=place.at).certificate
    return common_name_of(certificate.subject) if certificate else ""


def _planned(stated: Enclave, root: Path | None, place: Place) -> Material:
    """What the policy would give, under the governance of the keystore or of a new one."""
    from sros_tool.dds.domains import DomainSet
    from sros_tool.explain.material import from_policy
    from sros_tool.keystore.open import governance_of
    from sros_tool.keystore.template import DEFAULT_TEMPLATE, load_template
    from sros_tool.translate import governance_for

    if root is not None:
        return from_policy(stated, governance_of(root), at=place.at)
    domain = place.setting(None).domain
    protection = load_template(DEFAULT_TEMPLATE).protection
    return from_policy(
        stated, governance_for(protection, DomainSet.of((domain, domain))), at=place.at
    )


def vendor_of(name: str | None) -> tuple[Vendor, str]:
    """The vendor of an option, or else of this machine, and why it is that one."""
    from sros_tool.dds.decision import Vendor
    from sros_tool.explain.vendor import vendor_here

    if name:
        return Vendor(name), "as asked"
    choice = vendor_here(os.environ)
    return choice.vendor, choice.why

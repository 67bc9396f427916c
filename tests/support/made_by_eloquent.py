"""Flat keystores, as ros2/sros2 made them for ROS 2 Dashing (0.7) and Eloquent (0.8).

Facts: its sources of the branches dashing and eloquent.  The CA lies at the top, named sros2testCA;
the folder of a node has the name of the node, with copies of the CA and of the governance.  Dashing
ran openssl, and left its configuration, requests, index and a copy of each certificate.  All files
are as open as the umask lets them be.  Permissions end in October 2023, and have no
ros_discovery_info.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from tests.support.made_by_ros2 import GOVERNANCE, SCHEMA, XML, issue, sign, write

_CONFIGURATION = """[ ca ]
default_ca = CA_default
[ CA_default ]
dir = .
database = $dir/index.txt
unique_subject = no
new_certs_dir = $dir
certificate = $dir/ca.cert.pem
private_key = $dir/ca.key.pem
serial = $dir/serial
default_md = sha256
preserve = no
policy = policy_match
x509_extensions = local_ca_extensions
copy_extensions = copy
[ policy_match ]
commonName = supplied
[ local_ca_extensions ]
basicConstraints = CA:false
[ req ]
prompt = no
distinguished_name = req_distinguished_name
string_mask = utf8only
x509_extensions = root_ca_extensions
[ req_distinguished_name ]
commonName = sros2testCA
[ root_ca_extensions ]
basicConstraints = CA:true
"""
_REQUEST = """prompt = no
string_mask = utf8only
distinguished_name = req_distinguished_name
[ req_distinguished_name ]
commonName = {}
"""
EVERYTHING = ("rq/*Request", "rr/*Reply", "rt/*")
Topics = tuple[str, ...]


def permissions(name: str, topics: Topics, domain: int) -> str:
    """Return the permissions of a node that may publish and subscribe the DDS topics."""
    items = "".join(f"<topic>{each}</topic>" for each in topics)
    rules = (
        f"<allow_rule><domains><id>{domain}</id></domains>"
        f"<publish><topics>{items}</topics></publish>"
        f"<subscribe><topics>{items}</topics></subscribe></allow_rule>"
        if topics
        else ""
    )
    return (
        f"<dds {SCHEMA.format('permissions')}>\n<permissions>\n"
        f'<grant name="{name}"><subject_name>CN={name}</subject_name>\n'
        "<validity><not_before>2013-10-26T00:00:00</not_before>"
        "<not_after>2023-10-26T22:45:30</not_after></validity>\n"
        f"{rules}<default>DENY</default></grant>\n</permissions>\n</dds>\n"
    )


def make_eloquent(
    root: Path,
    nodes: Mapping[str, Topics],
    *,
    now: datetime,
    domain: int = 0,
    changed: tuple[str, str] = ("", ""),
) -> None:
    """Make the keystore of Eloquent with the DDS topics of its nodes.

    In its governance the first text of ``changed`` is replaced by the second.
    """
    root.mkdir(parents=True)
    authority, key = issue("sros2testCA", now)
    write(root / "ca.cert.pem", authority, root / "ca.key.pem", key)
    text = XML + GOVERNANCE.format(schema=SCHEMA.format("governance"), domain=domain)
    text = text.replace(*changed) if changed[0] else text
    sign(root / "governance", text, authority, key)
    for name, topics in nodes.items():
        folder = _folder(root, name)
        certificate, own = issue(name, now, (authority, key))
        write(folder / "cert.pem", certificate, folder / "key.pem", own)
        sign(folder / "permissions", permissions(name, topics, domain), authority, key)


def make_dashing(root: Path, nodes: Mapping[str, Topics], *, domain: int = 0) -> None:
    """Make the keystore of Dashing, by the commands of openssl that it ran."""
    root.mkdir(parents=True)
    (root / "ca_conf.cnf").write_text(_CONFIGURATION)
    (root / "index.txt").touch()
    (root / "serial").write_text("1000")
    _openssl(root, "ecparam -name prime256v1 -out ecdsaparam")
    _openssl(
        root,
        "req -nodes -x509 -days 3650 -newkey ec:ecdsaparam -keyout ca.key.pem -out ca.cert.pem "
        "-config ca_conf.cnf",
    )
    text = XML + GOVERNANCE.format(schema=SCHEMA.format("governance"), domain=domain)
    _sign(root, root / "governance.xml", text)
    for name, topics in nodes.items():
        folder = _folder(root, name)
        place = name[1:]
        shutil.copyfile(root / "ecdsaparam", folder / "ecdsaparam")
        (folder / "request.cnf").write_text(_REQUEST.format(name))
        _openssl(
            root,
            f"req -nodes -new -newkey ec:{place}/ecdsaparam -config {place}/request.cnf "
            f"-keyout {place}/key.pem -out {place}/req.pem",
        )
        _openssl(
            root,
            "ca -batch -create_serial -config ca_conf.cnf -days 3650 "
            f"-in {place}/req.pem -out {place}/cert.pem",
        )
        _sign(root, folder / "permissions.xml", permissions(name, topics, domain))
    for key in root.rglob("*key.pem"):
        key.chmod(0o644)  # openssl of that time left it to the umask


def _folder(root: Path, name: str) -> Path:
    folder = root / name[1:]
    folder.mkdir(parents=True, exist_ok=True)
    for role in ("identity", "permissions"):
        shutil.copyfile(root / "ca.cert.pem", folder / f"{role}_ca.cert.pem")
    shutil.copyfile(root / "governance.p7s", folder / "governance.p7s")
    return folder


def _sign(root: Path, document: Path, text: str) -> None:
    document = document.absolute()
    document.write_text(text)
    target = document.with_suffix(".p7s")
    _openssl(
        root,
        f"smime -sign -in {document} -text -out {target} -signer ca.cert.pem -inkey ca.key.pem",
    )


def _openssl(root: Path, words: str) -> None:
    done = subprocess.run(["openssl", *words.split()], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, (words, done.stderr)


def age(nodes: Mapping[str, Topics], root: Path, now: datetime) -> None:
    """Make a keystore of Eloquent whose certificates have expired, and whose CA has not."""
    make_eloquent(root, nodes, now=now)
    authority = x509.load_pem_x509_certificate((root / "ca.cert.pem").read_bytes())
    key = load_pem_private_key((root / "ca.key.pem").read_bytes(), None)
    for name in nodes:
        folder = root / name[1:]
        earlier = now - timedelta(days=4000)
        certificate, own = issue(name, earlier, (authority, key))  # type: ignore[arg-type]
        write(folder / "cert.pem", certificate, folder / "key.pem", own)


if __name__ == "__main__":
    make_eloquent(
        Path(sys.argv[1]),
        {"/talker": EVERYTHING, "/listener": EVERYTHING},
        now=datetime(2023, 5, 1, tzinfo=UTC),
    )

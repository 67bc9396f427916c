"""The web server of docs/howto/fleet_server.md: a real nginx, with paths of this machine."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

NGINX = "/usr/sbin/nginx"
_PAGE = Path(__file__).parents[2] / "docs/howto/fleet_server.md"
_AROUND = """
{main}
pid {folder}/nginx.pid;
error_log {folder}/error.log;
events {{ worker_connections 4000; }}
http {{
    {log}
    proxy_temp_path {folder}/t1;
    fastcgi_temp_path {folder}/t2;
    uwsgi_temp_path {folder}/t3;
    scgi_temp_path {folder}/t4;
    include {folder}/fleet.conf;
}}
"""


def certify_server(folder: Path, keystore: Path, address: str = "127.0.0.1") -> Path:
    """Make ``folder/etc`` with the server's certificate, its clients' CA, and that CA's list.

    Return the file with the certificate of the server.
    """
    etc = folder / "etc"
    etc.mkdir()
    for file in ("identity_ca.cert.pem", "identity_ca.crl.pem"):
        shutil.copy(keystore / "public" / file, etc)
    certificate = etc / "server.cert.pem"
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "ec", "-nodes", "-subj", "/CN=home"),
            *("-pkeyopt", "ec_paramgen_curve:prime256v1"),
            *("-addext", f"subjectAltName=IP:{address}"),
            *("-keyout", etc / "server.key.pem", "-out", certificate),
        ],
        check=True,
        capture_output=True,
    )
    return certificate


def nginx_of_page(
    folder: Path,
    place: Path,
    *,
    listen: str = "443",
    log: str = "access_log off;",
    main: str = "",
) -> list[str]:
    """Write the configuration of the page into the new folder ``place``; return nginx's command.

    Args:
        folder: has ``etc``, as `certify_server` makes it, and ``srv`` in place of /srv/fleet.
        place: the folder of the process.
        listen: where it listens.
        log: its lines on what it logs.
        main: further lines.
    """
    (text,) = re.findall(r"```nginx\n(.*?)```", _PAGE.read_text(), re.DOTALL)
    edits = {
        "/etc/nginx/fleet/": f"{folder}/etc/",
        "/srv/fleet": f"{folder}/srv",
        "listen 443": f"listen {listen}",
    }
    for before, after in edits.items():
        assert before in text, before
        text = text.replace(before, after)
    place.mkdir()
    (place / "fleet.conf").write_text(text)
    if os.geteuid() == 0:
        main += "user root;"
    (place / "nginx.conf").write_text(_AROUND.format(folder=place, main=main, log=log))
    return [NGINX, "-p", str(place), "-c", str(place / "nginx.conf")]

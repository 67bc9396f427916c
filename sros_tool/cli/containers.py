"""What `env` prints for containers: an enclave as a service of Compose, objects of Kubernetes."""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Mapping
from contextlib import suppress
from io import UnsupportedOperation
from pathlib import Path, PurePosixPath
from shlex import quote

from sros_tool.cli.common import now
from sros_tool.errors import KeystoreError, UsageError

INSTALLED = "/etc/sros/keystore"
"""Where a robot or a container has its keystore, unless another path is named."""


def target_path(text: str) -> Path:
    """Return the path of a keystore on another machine.

    Raises:
        UsageError: it is not absolute, or not in its shortest form.
    """
    path = PurePosixPath(text)
    if not path.is_absolute() or ".." in path.parts or str(path) != text or text.startswith("//"):
        raise UsageError(
            f"--target {text!r} is not the path of a keystore on another machine",
            "It must be absolute, without '..', '//' and a '/' at the end.",
            f"Write it as {INSTALLED}.",
        )
    return Path(text)


def container_text(
    root: Path, enclave: str, form: str, target: Path, variables: Mapping[str, str], name: str,
    image: str,
) -> str:  # fmt: skip
    """Return an enclave as a service of Compose, or as objects of Kubernetes.

    Args:
        root: the keystore.
        enclave: one of its enclaves, in which a process can run.
        form: one of `sros_tool.runtime.containers.FORMS`.
        target: the keystore in the container and, for Compose, on the machine that runs it.
        variables: the environment of the enclave there.
        name: the name of the service or object; "" stands for one that no other enclave has.
        image: the image, or "".

    Raises:
        UsageError: a name is not valid, or others could read the private key in the output.
        KeystoreError: the container would see the keys of other enclaves, or no files.
    """
    from sros_tool.keystore.delivery.export import exported_files
    from sros_tool.keystore.layout import enclave_path
    from sros_tool.runtime.containers import (
        COMPOSE,
        SECRET,
        Container,
        check_name,
        object_name,
        render_container,
        render_secret,
    )

    if form == SECRET:
        _refuse_open_output()
        files = exported_files(root, (enclave,), now())
        return render_secret(enclave, {PurePosixPath(path).name: files[path] for path in files})
    if form == COMPOSE:
        _check_mounted(root, enclave, target)
    name = check_name(name, form) if name else object_name(enclave)
    folder = str(enclave_path(target, enclave))
    return render_container(Container(enclave, name, variables, folder, image), form)


def _check_mounted(root: Path, enclave: str, target: Path) -> None:
    """Raise `KeystoreError` if the folder of an enclave cannot be mounted alone."""
    from sros_tool.keystore.layout import enclaves_below
    from sros_tool.keystore.reader import open_keystore

    export = f"`sros distribute_key {quote(str(root))} {quote(enclave)} DIR`"
    if inner := enclaves_below(root, enclave):
        raise KeystoreError(
            f"the folder of enclave {enclave} also has {', '.join(inner[:3])}",
            "The container would get the private keys of all of them.",
            f"Export this enclave alone, {export}, and name DIR as the keystore.",
        )
    if open_keystore(root).is_home and target == root.absolute():
        raise KeystoreError(
            f"a container cannot use '{target}' itself",
            "Files of an enclave are links to others of the keystore, which it would not have.",
            f"Export the enclave, {export}, and name the path of DIR with --target.",
        )


def _refuse_open_output() -> None:
    """Raise `UsageError` if standard output is a terminal, or a file that others can read."""
    command = "Use a pipe, `| kubectl apply --server-side -f -`, or a file after `umask 077`."
    if sys.stdout is not None and sys.stdout.isatty():
        raise UsageError(
            "a private key would be written to this terminal", "A Secret is not encrypted.", command
        )
    with suppress(UnsupportedOperation):
        state = os.fstat(sys.stdout.fileno())
        if stat.S_ISREG(state.st_mode) and state.st_mode & 0o077:
            raise UsageError(
                "a private key would be written to a file that others can read",
                f"The mode of the file is {stat.S_IMODE(state.st_mode):04o}.",
                command,
            )

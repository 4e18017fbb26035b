"""Signatures of controllers: `unjam keys` makes a key pair, `unjam sign` signs with the private key."""

import os
from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import JsonOption
from unjam.cli.output import console, err_console, print_json
from unjam.errors import invalid_value


def keys_command(
    name: Annotated[Path, typer.Argument(help="Path of both files without their suffix.")], json: JsonOption = False
) -> None:
    """Make a key pair to sign controllers with: NAME.key, which you keep secret, and NAME.pub for others.

    Existing files are never overwritten. Anyone with NAME.key can sign in your name: it has no password, and only
    you can read it.

    Example:

      unjam keys maker
    """
    from unjam.controller.signature import make_keys

    keys = make_keys(name)
    if json:
        print_json({"private": str(keys.private), "public": str(keys.public), "fingerprint": keys.fingerprint})
        return
    console.print(f"{keys.private}: keep it secret", soft_wrap=True)
    console.print(f"{keys.public}: for verification by others; fingerprint {keys.fingerprint}", soft_wrap=True)


def sign_command(
    file: Annotated[Path, typer.Argument(help="A .unjam file; the signature is added to it.")],
    key: Annotated[Path, typer.Option(help="Private key (.key) of `unjam keys`.")],
    replace: Annotated[bool, typer.Option("--replace", help="Replace the signature of another key.")] = False,
    json: JsonOption = False,
) -> None:
    """Sign a controller, so that others can verify its maker, and that nothing in it has changed since.

    The signature becomes a part of the file, which every reader checks. Sign last: a signed file cannot be
    certified.

    Examples:

      unjam sign ring.unjam --key maker.key

      unjam verify ring.unjam --signer maker.pub
    """
    from unjam.controller.file import add_signature, read_controller
    from unjam.controller.signature import fingerprint_of, read_private_key

    if os.path.isdir(file):
        raise invalid_value("file", str(file), "a .unjam file")
    private, controller = read_private_key(key), read_controller(file)
    fingerprint, previous = fingerprint_of(private.public_key()), controller.signed_by
    if previous not in (None, fingerprint) and not replace:
        allowed = f"a file without the signature of another key (it is signed by {previous}); or --replace"
        raise invalid_value("file", str(file), allowed)
    add_signature(file, controller, private)
    if json:
        print_json({"file": str(file), "fingerprint": fingerprint, "previous_fingerprint": previous})
        return
    console.print(f"{file}: signed by {fingerprint}", soft_wrap=True)
    if os.name == "posix" and key.stat().st_mode & 0o077:
        err_console.print(f"note: other users of this machine can read {key}: chmod 600", soft_wrap=True)

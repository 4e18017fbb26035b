"""Who made a controller: `unjam keys` makes a pair of keys, `sign_command` signs with the private one."""

import os
from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import JsonOption
from unjam.cli.output import console, err_console, print_json
from unjam.errors import invalid_value


def keys_command(
    name: Annotated[Path, typer.Argument(help="What the names of both files begin with.")], json: JsonOption = False
) -> None:
    """Make keys to sign controllers with: NAME.key, which you keep for yourself, and NAME.pub for others.

    Files that are there already are never written over. Whoever has NAME.key can sign in your name: it has no
    password, and is readable for you alone.

    Example:

      unjam keys maker
    """
    from unjam.controller.signature import make_keys

    made = make_keys(name)
    if json:
        files = {"private": str(made.private), "public": str(made.public)}
        print_json({**files, "fingerprint": made.fingerprint})
        return
    console.print(f"{made.private}: keep it for yourself", soft_wrap=True)
    console.print(f"{made.public}: for who verifies; fingerprint {made.fingerprint}", soft_wrap=True)


def sign_command(
    file: Annotated[Path, typer.Argument(help="A .unjam file; it gets the signature.")],
    key: Annotated[Path, typer.Option(help="Private key (.key) of `unjam keys`.")],
    replace: Annotated[
        bool, typer.Option("--replace", help="Sign also where another key has signed; that is then gone.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Sign a controller, so that others can tell who made it, and that nothing in it has changed since.

    The signature becomes a part of the file, which every reader checks. Sign last: to certify a signed file
    is refused.

    Examples:

      unjam sign ring.unjam --key maker.key

      unjam verify ring.unjam --signer maker.pub
    """
    from unjam.controller.file import add_signature, read_controller
    from unjam.controller.signature import fingerprint_of, read_private_key

    if os.path.isdir(file):
        raise invalid_value("file", str(file), "a .unjam file")
    private, controller = read_private_key(key), read_controller(file)
    fingerprint, before = fingerprint_of(private.public_key()), controller.signed_by
    if before not in (None, fingerprint) and not replace:
        raise invalid_value(
            "file", str(file), f"one that nobody else has signed (it is signed by {before}); or --replace"
        )
    add_signature(file, controller, private)
    if json:
        print_json({"file": str(file), "fingerprint": fingerprint, "replaced": before})
        return
    console.print(f"{file}: signed by {fingerprint}", soft_wrap=True)
    if os.name == "posix" and key.stat().st_mode & 0o077:
        err_console.print(f"note: others on this machine may use {key}: chmod 600", soft_wrap=True)

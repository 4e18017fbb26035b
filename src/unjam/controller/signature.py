"""Who made a controller: Ed25519 keys, the signature that a file carries, and whether it fits.

What is signed is a text: a line that says what it is, one with the public key, and the SHA-256 and name of
each other part, sorted by name, the manifest among them. Whoever imports this loads `cryptography`, so it is
imported where there are keys or signatures alone.
"""

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

from unjam.errors import InputError, MissingPartError, invalid_value
from unjam.files import check_parent_folder, remove, to_json, write_new_file

try:
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import (
        Encoding,
        NoEncryption,
        PrivateFormat,
        PublicFormat,
        load_pem_private_key,
        load_pem_public_key,
    )
except ImportError:
    _MISSING_PACKAGE = "cryptography is not installed; signatures need it"
    raise MissingPartError(f"{_MISSING_PACKAGE}: pip install cryptography") from None

PRIVATE_SUFFIX, PUBLIC_SUFFIX = ".key", ".pub"
"""what the names of key files end in"""
PRIVATE_KEY_DESCRIPTION = "an Ed25519 private key in PEM without a password, as `unjam keys` writes it"
PUBLIC_KEY_DESCRIPTION = "an Ed25519 public key in PEM, as `unjam keys` writes it"
PRIVATE_FILE_MODE, PUBLIC_FILE_MODE = 0o600, 0o644
"""who may read a file"""
MAX_KEY_BYTES = 10_000
"""bytes of a key's file"""
FIELD_PRIME = 2**255 - 19
GROUP_ORDER = 2**252 + 27742317777372353535851937790883648493
_ORDER_8 = 0x05FC536D880238B13933C6D305ACDFD5F098EFF289F4C345B027B2C28F95E826
SMALL_ORDER_POINTS = {0, 1, FIELD_PRIME - 1, _ORDER_8, FIELD_PRIME - _ORDER_8}
"""y coordinates of the eight points whose order divides 8: with such a key one signature fits any message.
Source: RFC 8032, section 5.1; Chalkias et al. 2020, Taming the many EdDSAs"""
WEAK_KEY_TEXT = "a weak Ed25519 key, for which signatures can be forged,"
SIGNATURE_HEADER = "unjam controller, signature 1"
"""the first line of what is signed: nothing else that is signed with the same key can be taken for it"""


@dataclass(frozen=True)
class KeyPair:
    """The files of a private and a public key, and which key it is."""

    private: Path
    public: Path
    fingerprint: str


def make_keys(name: Path) -> KeyPair:
    """Write a new pair of keys beside each other: `NAME.key`, for its owner alone, and `NAME.pub`.

    Raises:
        InputError: there is a file of one of both names.
        DiskError: they cannot be written; neither is there then.
    """
    if not name.name:
        raise invalid_value("name", str(name), "what the names of two new files begin with")
    private, public = (name.with_name(name.name + ending) for ending in (PRIVATE_SUFFIX, PUBLIC_SUFFIX))
    check_parent_folder(private)
    for file in (private, public):
        if os.path.lexists(file):
            raise invalid_value("name", str(name), f"one of which there are no keys yet: {str(file)!r} exists")
    key = Ed25519PrivateKey.generate()
    known = key.public_key()
    secret = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    write_new_file(private, secret, PRIVATE_FILE_MODE)
    try:
        shown = known.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
        write_new_file(public, shown, PUBLIC_FILE_MODE)
    except BaseException:
        remove(private)
        raise
    return KeyPair(private, public, fingerprint_of(known))


def read_private_key(file: Path) -> Ed25519PrivateKey:
    """Return the key of a file; raise `InputError` where it is no Ed25519 private key in PEM."""
    content = _read_key_file("key", file, PRIVATE_KEY_DESCRIPTION)
    try:
        key = load_pem_private_key(content, None)
    except TypeError:  # it wants a password
        raise InputError(f"key: {str(file)!r} is encrypted; allowed: {PRIVATE_KEY_DESCRIPTION}") from None
    except (ValueError, UnsupportedAlgorithm):
        raise invalid_value("key", str(file), PRIVATE_KEY_DESCRIPTION) from None
    if not isinstance(key, Ed25519PrivateKey):
        raise invalid_value("key", str(file), PRIVATE_KEY_DESCRIPTION)
    if is_weak_point(key.public_key().public_bytes_raw()):
        raise InputError(f"key: {str(file)!r}: {WEAK_KEY_TEXT} is not allowed; allowed: {PRIVATE_KEY_DESCRIPTION}")
    return key


def read_public_key(file: Path) -> str:
    """Return the fingerprint of a file's key; raise `InputError` where it is no Ed25519 public key in PEM."""
    content = _read_key_file("signer", file, PUBLIC_KEY_DESCRIPTION)
    try:
        key = load_pem_public_key(content)
    except (ValueError, UnsupportedAlgorithm):
        raise invalid_value("signer", str(file), PUBLIC_KEY_DESCRIPTION) from None
    if not isinstance(key, Ed25519PublicKey):
        raise invalid_value("signer", str(file), PUBLIC_KEY_DESCRIPTION)
    if is_weak_point(key.public_bytes_raw()):
        raise InputError(f"signer: {str(file)!r}: {WEAK_KEY_TEXT} is not allowed; allowed: {PUBLIC_KEY_DESCRIPTION}")
    return fingerprint_of(key)


def is_weak_point(point: bytes) -> bool:
    """Return whether the encoding of a point is not canonical, or the point is of small order."""
    y = int.from_bytes(point, "little") & (2**255 - 1)  # without the sign of x
    return y >= FIELD_PRIME or y in SMALL_ORDER_POINTS


def fingerprint_of(key: Ed25519PublicKey) -> str:
    """Return the SHA-256 of a public key in DER: `openssl pkey -pubin -outform DER | sha256sum`."""
    return hashlib.sha256(key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)).hexdigest()


def signature_of(parts: dict[str, bytes], key: Ed25519PrivateKey) -> bytes:
    """Return the part of an archive that says who signed its other `parts`; the same for the same of both."""
    known = key.public_key()
    raw = known.public_bytes_raw()
    return _signature_json(known, raw, key.sign(_signed_message(parts, raw)))


def signer_of(name: str, parts: dict[str, bytes], part: bytes) -> str:
    """Return the fingerprint of the key that signed `parts`, as `part` says, of the controller `name`.

    Raises:
        InputError: it is not a signature, it does not fit, or it is of a weak key or malleable: a second
            encoding of another signature.
    """
    none_of_ours = InputError(f"controller {name}: its signature is not one that unjam writes")
    try:
        said = json.loads(part)
        raw, signature = bytes.fromhex(said["public_key"]), bytes.fromhex(said["signature"])
        key = Ed25519PublicKey.from_public_bytes(raw)
    except (ValueError, LookupError, TypeError, RecursionError):
        raise none_of_ours from None
    if part != _signature_json(key, raw, signature):  # something else stands there too
        raise none_of_ours
    if is_weak_point(raw):
        raise InputError(f"controller {name}: it is signed by {WEAK_KEY_TEXT} which is not allowed")
    if is_weak_point(signature[:32]) or int.from_bytes(signature[32:], "little") >= GROUP_ORDER:
        raise forged_error(name)
    try:
        key.verify(signature, _signed_message(parts, raw))
    except InvalidSignature:
        raise forged_error(name) from None
    return fingerprint_of(key)


def forged_error(name: str) -> InputError:
    """Return the error for a controller that is whole, but not what was signed."""
    return InputError(f"controller {name}: forged: it was changed after it was signed")


def _signed_message(parts: dict[str, bytes], public_key: bytes) -> bytes:
    hashes = [f"{hashlib.sha256(part).hexdigest()}  {name}" for name, part in sorted(parts.items())]
    return "".join(f"{line}\n" for line in (SIGNATURE_HEADER, f"public key {public_key.hex()}", *hashes)).encode()


def _signature_json(key: Ed25519PublicKey, public_key: bytes, signature: bytes) -> bytes:
    said = {"fingerprint": fingerprint_of(key), "public_key": public_key.hex(), "signature": signature.hex()}
    return to_json({"algorithm": "Ed25519", **said}, indent=1).encode()


def _read_key_file(field: str, file: Path, allowed: str) -> bytes:
    """Return the content of a key's file; a pipe or a device is not waited for."""
    if not os.path.exists(file):
        raise InputError(f"{field}: {str(file)!r} does not exist; allowed: {allowed}")
    if not os.path.isfile(file) or os.path.getsize(file) > MAX_KEY_BYTES:
        raise invalid_value(field, str(file), allowed)
    return file.read_bytes()

"""Ed25519 signatures of controllers; import this module only for keys and signatures, because it loads `cryptography`.

The signed message is a text: a header, a line with the public key, and lines with SHA-256 and name of each part except
the signature, sorted by name.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from unjam.errors import InputError, invalid_value, missing_package_error
from unjam.files import check_parent_folder, remove, sha256_of, to_json, write_new_file

try:
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat
except ImportError as error:
    raise missing_package_error(error, "cryptography") from None

MAX_KEY_BYTES = 10_000  # largest size of a key file
FIELD_PRIME = 2**255 - 19
GROUP_ORDER = 2**252 + 27742317777372353535851937790883648493
_ORDER_8 = 0x05FC536D880238B13933C6D305ACDFD5F098EFF289F4C345B027B2C28F95E826
SMALL_ORDER_POINTS = {0, 1, FIELD_PRIME - 1, _ORDER_8, FIELD_PRIME - _ORDER_8}
"""y coordinates of the eight points with an order that divides 8: with such a key, one signature is valid for any
message. Source: RFC 8032, section 5.1; Chalkias et al. 2020, Taming the many EdDSAs"""
WEAK_KEY_TEXT = "a weak Ed25519 key, for which signatures can be forged,"
SIGNATURE_HEADER = "unjam controller, signature 1"  # distinguishes the message from others signed with the same key
KeyT = TypeVar("KeyT", Ed25519PrivateKey, Ed25519PublicKey)


@dataclass(frozen=True)
class KeyPair:
    """The files of a private and a public key, and the fingerprint of the key."""

    private: Path
    public: Path
    fingerprint: str


def make_keys(name: Path) -> KeyPair:
    """Write a key pair to the new files `NAME.key`, readable only by its owner, and `NAME.pub`; both or neither."""
    if not name.name:
        raise invalid_value("name", str(name), "the common start of the names of two new files")
    private_file, public_file = (name.with_name(name.name + suffix) for suffix in (".key", ".pub"))
    check_parent_folder(private_file)
    for file in (private_file, public_file):
        if os.path.lexists(file):
            raise invalid_value("name", str(name), f"a name without keys: {str(file)!r} exists")
    private_key = Ed25519PrivateKey.generate()
    public_key = private_key.public_key()
    private_pem = private_key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    write_new_file(private_file, private_pem, mode=0o600)
    try:
        public_pem = public_key.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
        write_new_file(public_file, public_pem, mode=0o644)
    except BaseException:
        remove(private_file)
        raise
    return KeyPair(private_file, public_file, fingerprint_of(public_key))


def read_private_key(file: Path) -> Ed25519PrivateKey:
    """Return the key in a file; raise `InputError` unless it is an Ed25519 private key in PEM."""
    return _read_key("key", file, "private key in PEM without a password", Ed25519PrivateKey)


def read_public_key(file: Path) -> str:
    """Return the fingerprint of the key in a file; raise `InputError` unless it is an Ed25519 public key in PEM."""
    return fingerprint_of(_read_key("signer", file, "public key in PEM", Ed25519PublicKey))


def _read_key(field: str, file: Path, kind: str, key_class: type[KeyT]) -> KeyT:
    allowed = f"an Ed25519 {kind}, as `unjam keys` writes it"
    if not os.path.exists(file):
        raise InputError(f"{field}: {str(file)!r} does not exist; allowed: {allowed}")
    if not os.path.isfile(file) or os.path.getsize(file) > MAX_KEY_BYTES:  # a pipe or a device could block
        raise invalid_value(field, str(file), allowed)
    try:
        content = file.read_bytes()
    except OSError as error:  # reading some special files fails
        raise InputError(f"{field}: {str(file)!r} cannot be read: {error.strerror}; allowed: {allowed}") from None
    try:
        is_private = key_class is Ed25519PrivateKey
        load_private, load_public = serialization.load_pem_private_key, serialization.load_pem_public_key
        key: Any = load_private(content, None) if is_private else load_public(content)
    except TypeError:  # the key needs a password
        raise InputError(f"{field}: {str(file)!r} is encrypted; allowed: {allowed}") from None
    except (ValueError, UnsupportedAlgorithm):
        key = None
    if not isinstance(key, key_class):
        raise invalid_value(field, str(file), allowed)
    public_key = key.public_key() if isinstance(key, Ed25519PrivateKey) else key
    if is_weak_point(public_key.public_bytes_raw()):
        raise InputError(f"{field}: {str(file)!r}: {WEAK_KEY_TEXT} is not allowed; allowed: {allowed}")
    return key


def is_weak_point(point: bytes) -> bool:
    """Return whether the encoding of a point is not canonical, or the point is of small order."""
    y = int.from_bytes(point, "little") & (2**255 - 1)  # without the sign of x
    return y >= FIELD_PRIME or y in SMALL_ORDER_POINTS


def fingerprint_of(key: Ed25519PublicKey) -> str:
    """Return the SHA-256 of a public key in DER: `openssl pkey -pubin -outform DER | sha256sum`."""
    return sha256_of(key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo))


def signature_of(parts: dict[str, bytes], key: Ed25519PrivateKey) -> bytes:
    """Return the signature part of an archive with the other `parts`; equal arguments give equal bytes."""
    public_key = key.public_key()
    public_bytes = public_key.public_bytes_raw()
    return _signature_json(public_key, public_bytes, key.sign(_signed_message(parts, public_bytes)))


def signer_of(name: str, parts: dict[str, bytes], signature_part: bytes) -> str:
    """Return the fingerprint of the key that signed `parts`; raise `InputError` if the signature is not valid."""
    format_error = InputError(f"controller {name}: its signature is not one that unjam writes")
    try:
        document = json.loads(signature_part)
        public_bytes, signature = bytes.fromhex(document["public_key"]), bytes.fromhex(document["signature"])
        key = Ed25519PublicKey.from_public_bytes(public_bytes)
    except (ValueError, LookupError, TypeError, RecursionError):
        raise format_error from None
    if signature_part != _signature_json(key, public_bytes, signature):  # the part contains something else
        raise format_error
    if is_weak_point(public_bytes):
        raise InputError(f"controller {name}: it is signed by {WEAK_KEY_TEXT} which is not allowed")
    if is_weak_point(signature[:32]) or int.from_bytes(signature[32:], "little") >= GROUP_ORDER:
        raise forged_error(name)
    try:
        key.verify(signature, _signed_message(parts, public_bytes))
    except InvalidSignature:
        raise forged_error(name) from None
    return fingerprint_of(key)


def forged_error(name: str) -> InputError:
    """Return the error for an undamaged controller that differs from the signed one."""
    return InputError(f"controller {name}: forged: it was changed after it was signed")


def _signed_message(parts: dict[str, bytes], public_bytes: bytes) -> bytes:
    hash_lines = [f"{sha256_of(part)}  {name}" for name, part in sorted(parts.items())]
    lines = SIGNATURE_HEADER, f"public key {public_bytes.hex()}", *hash_lines
    return "".join(f"{line}\n" for line in lines).encode()


def _signature_json(key: Ed25519PublicKey, public_bytes: bytes, signature: bytes) -> bytes:
    entries = {"fingerprint": fingerprint_of(key), "public_key": public_bytes.hex(), "signature": signature.hex()}
    return to_json({"algorithm": "Ed25519", **entries}, indent=1).encode()

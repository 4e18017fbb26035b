"""Changes after signing are detected, and the signer is identified."""

import hashlib
import json
import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.asymmetric.rsa import generate_private_key
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    KeySerializationEncryption,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.controller.test_file import written
from tests.controller.test_verify import content_of, refusal_message
from unjam.controller import load_controller, packaged_file
from unjam.controller.file import (
    ARCHIVE_PARTS,
    CERTIFICATE_PART,
    GRAPH_PART,
    MANIFEST_PART,
    SAMPLE_PART,
    SIGNATURE_PART,
    WEIGHTS_PART,
    Controller,
    add_certificate,
    add_signature,
    pack_parts,
    read_controller,
    unpack_parts,
)
from unjam.controller.signature import fingerprint_of, make_keys, read_private_key, read_public_key
from unjam.controller.verify import verify_controller_file
from unjam.errors import DiskError, InputError
from unjam.files import sha256_of

KEY, OTHER = (Ed25519PrivateKey.from_private_bytes(bytes([number] * 32)) for number in (1, 2))
FINGERPRINT = fingerprint_of(KEY.public_key())
FORGED = "controller it.unjam: forged: it was changed after it was signed"
NONE = "controller it.unjam: its signature is not one that unjam writes"
ALL = {GRAPH_PART: b"drawn", CERTIFICATE_PART: b"{}"}
"""parts that are not read before the signature is checked"""


def write_signed(folder: Path, key: Ed25519PrivateKey = KEY, parts: dict[str, bytes] | None = None) -> Path:
    path = written(folder, content_of(parts=parts))
    add_signature(path, read_controller(path), key)
    return path


def forge(parts: dict[str, bytes]) -> bytes:
    """An archive of changed parts, with a manifest that names their hashes."""
    manifest = json.loads(parts[MANIFEST_PART])
    manifest["sha256"] = {name: sha256_of(part) for name, part in parts.items() if name in ARCHIVE_PARTS[1:-1]}
    return pack_parts({**parts, MANIFEST_PART: json.dumps(manifest, indent=1).encode()})


def public_file(folder: Path, key: Ed25519PrivateKey = KEY) -> Path:
    path = folder / "maker.pub"
    path.write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    return path


def found(path: Path, signer: Path | None = None) -> str:
    return next(each.detail for each in verify_controller_file(path, signer) if each.part == "signature")


@pytest.mark.parametrize(
    "write", [lambda path, old: add_certificate(path, old, {}), lambda path, old: add_signature(path, old, KEY)]
)
def test_a_file_that_another_process_replaced_meanwhile_is_not_overwritten(
    write: Callable[[Path, Controller], None], tmp_path: Path
) -> None:
    path = written(tmp_path, content_of(parts={}))
    old = read_controller(path)
    add_signature(path, old, OTHER)
    newer = path.read_bytes()
    with pytest.raises(InputError, match="has changed meanwhile"):
        write(path, old)
    assert path.read_bytes() == newer


def test_who_signed_is_told(tmp_path: Path) -> None:
    path = write_signed(tmp_path)
    said = found(path)
    assert f", by the key {FINGERPRINT}; the owner of the key was not checked: " in said
    of_maker = f", by {str(tmp_path / 'maker.pub')!r}, the key {FINGERPRINT}"
    assert found(path, public_file(tmp_path)).endswith(of_maker)
    assert read_controller(path).signed_by == FINGERPRINT


def test_a_file_without_a_signature_is_read_as_before(tmp_path: Path) -> None:
    path = written(tmp_path, content_of())
    assert found(path).startswith("its maker is unknown, ")
    assert read_controller(path).signed_by is None
    assert read_controller(packaged_file("ring-best")).signed_by is None


def test_the_other_parts_stay_as_they_are_and_a_signature_is_reproducible(tmp_path: Path) -> None:
    path = write_signed(tmp_path)
    parts, content = unpack_parts(path), path.read_bytes()
    assert parts.pop(SIGNATURE_PART)
    assert pack_parts(parts) == content_of()
    add_signature(path, read_controller(path), KEY)
    assert path.read_bytes() == content


def test_another_key_takes_the_place_of_the_first(tmp_path: Path) -> None:
    path = write_signed(tmp_path)
    add_signature(path, read_controller(path), OTHER)
    once = path.read_bytes()
    assert read_controller(path).signed_by == fingerprint_of(OTHER.public_key())
    assert write_signed(tmp_path, OTHER).read_bytes() == once


def test_what_is_signed_is_what_the_documentation_says(tmp_path: Path) -> None:
    parts = unpack_parts(write_signed(tmp_path, parts=ALL))
    said = json.loads(parts.pop(SIGNATURE_PART))
    lines = ["unjam controller, signature 1", f"public key {said['public_key']}"]
    lines += [f"{hashlib.sha256(parts[name]).hexdigest()}  {name}" for name in sorted(parts)]
    key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(said["public_key"]))
    key.verify(bytes.fromhex(said["signature"]), "".join(f"{line}\n" for line in lines).encode())
    assert len(lines) == 2 + 5
    der = key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    assert said["fingerprint"] == hashlib.sha256(der).hexdigest()


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(
    name=st.sampled_from([WEIGHTS_PART, SAMPLE_PART, GRAPH_PART, CERTIFICATE_PART]),
    place=st.floats(0, 1, exclude_max=True),
    bits=st.integers(1, 255),
)
def test_a_part_that_was_changed_with_its_hash_is_forged(name: str, place: float, bits: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        parts = unpack_parts(write_signed(Path(folder), parts=ALL))
        changed = bytearray(parts[name])
        changed[int(place * len(changed))] ^= bits
        assert refusal_message(written(Path(folder), forge({**parts, name: bytes(changed)}))) == FORGED
        with pytest.raises(InputError) as caught:
            load_controller(Path(folder, "it.unjam"))
        assert str(caught.value) == FORGED


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255))
def test_no_byte_of_a_signed_file_can_be_another(place: float, bits: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        content = bytearray(write_signed(Path(folder)).read_bytes())
        content[int(place * len(content))] ^= bits
        assert refusal_message(written(Path(folder), bytes(content)))


@pytest.mark.parametrize("name", [SAMPLE_PART, GRAPH_PART, CERTIFICATE_PART])
def test_a_part_that_is_gone_is_missed(tmp_path: Path, name: str) -> None:
    parts = unpack_parts(write_signed(tmp_path, parts=ALL))
    del parts[name]
    assert refusal_message(written(tmp_path, forge(parts))) == FORGED


def test_a_part_that_was_added_is_noticed(tmp_path: Path) -> None:
    parts = unpack_parts(write_signed(tmp_path))
    assert refusal_message(written(tmp_path, forge({**parts, CERTIFICATE_PART: b"{}"}))) == FORGED


@pytest.mark.parametrize(
    "change",
    [
        lambda manifest: manifest.update(scenario={"kind": "merge"}),
        lambda manifest: manifest.update(metrics={"gain": 1e9}),
        lambda manifest: manifest["driver"].update(action_repeat=1),
        lambda manifest: manifest.pop("iteration"),
    ],
)
def test_a_manifest_that_was_changed_is_forged(tmp_path: Path, change: Callable[[Any], object]) -> None:
    parts = unpack_parts(write_signed(tmp_path))
    manifest = json.loads(parts[MANIFEST_PART])
    change(manifest)
    assert (
        refusal_message(written(tmp_path, pack_parts({**parts, MANIFEST_PART: json.dumps(manifest).encode()})))
        == FORGED
    )


def test_a_wrong_hash_is_damage_in_a_signed_file_too(tmp_path: Path) -> None:
    parts = unpack_parts(write_signed(tmp_path))
    path = written(tmp_path, pack_parts({**parts, WEIGHTS_PART: parts[WEIGHTS_PART][:-1] + b"x"}))
    assert (
        refusal_message(path)
        == "controller it.unjam: damaged: weights.safetensors does not have the hash that it names"
    )


def test_another_order_or_date_of_the_parts_is_forged(tmp_path: Path) -> None:
    content = write_signed(tmp_path).read_bytes()
    backwards = pack_parts(dict(reversed(unpack_parts(tmp_path / "it.unjam").items())))
    for other in (backwards, content.replace(b"\x00\x00\x21\x00", b"\x00\x00\x22\x00")):
        assert other != content
        assert refusal_message(written(tmp_path, other)) == FORGED


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda said: said.update(public_key=OTHER.public_key().public_bytes_raw().hex()), NONE),
        (lambda said: said.update(fingerprint="0" * 64), NONE),
        (lambda said: said.update(algorithm="none"), NONE),
        (lambda said: said.update(public_key=said["public_key"].upper() + " "), NONE),
        (lambda said: said.update(public_key="00"), NONE),
        (lambda said: said.update(public_key=5), NONE),
        (lambda said: said.update(more=1), NONE),
        (lambda said: said.pop("signature"), NONE),
        (lambda said: said.update(signature=""), FORGED),
        (lambda said: said.update(signature="00" * 64), FORGED),
    ],
)
def test_a_signature_of_another_form_is_refused(tmp_path: Path, change: Callable[[Any], object], words: str) -> None:
    parts = unpack_parts(write_signed(tmp_path))
    said = json.loads(parts[SIGNATURE_PART])
    change(said)
    assert (
        refusal_message(written(tmp_path, pack_parts({**parts, SIGNATURE_PART: json.dumps(said, indent=1).encode()})))
        == words
    )


@pytest.mark.parametrize("part", [b"", b"[]", b"null", b"\xff", b"{}", b"[" * 9_000, b'{"public_key": "\\ud800"}'])
def test_nonsense_for_a_signature_is_refused(tmp_path: Path, part: bytes) -> None:
    parts = unpack_parts(write_signed(tmp_path))
    assert refusal_message(written(tmp_path, pack_parts({**parts, SIGNATURE_PART: part}))) == NONE


def test_the_signature_of_another_controller_does_not_fit(tmp_path: Path) -> None:
    other = unpack_parts(write_signed(tmp_path, parts=ALL))[SIGNATURE_PART]
    parts = unpack_parts(write_signed(tmp_path))
    assert refusal_message(written(tmp_path, pack_parts({**parts, SIGNATURE_PART: other}))) == FORGED


Point = tuple[int, int]
PRIME, ORDER = 2**255 - 19, 2**252 + 27742317777372353535851937790883648493
BASE_Y = 4 * pow(5, -1, PRIME) % PRIME
CURVE_D = -121665 * pow(121666, -1, PRIME) % PRIME


def points_at(y: int) -> list[Point]:
    """The points of edwards25519 with this y coordinate: -x^2 + y^2 = 1 + d x^2 y^2."""
    square = (y * y - 1) * pow(CURVE_D * y * y + 1, -1, PRIME) % PRIME
    root = pow(square, (PRIME + 3) // 8, PRIME)
    roots = {sign * root * turn % PRIME for sign in (1, -1) for turn in (1, pow(2, (PRIME - 1) // 4, PRIME))}
    return [(x, y) for x in sorted(roots) if x * x % PRIME == square]


def add_points(one: Point, other: Point) -> Point:
    (a, b), (c, d) = one, other
    both = CURVE_D * a * b * c * d
    x, y = (a * d + b * c) * pow(1 + both, -1, PRIME), (b * d + a * c) * pow(1 - both, -1, PRIME)
    return x % PRIME, y % PRIME


def times(factor: int, point: Point) -> Point:
    total = (0, 1)
    for bit in f"{factor:b}":
        total = add_points(total, total)
        total = add_points(total, point) if bit == "1" else total
    return total


def small_order() -> set[Point]:
    """All points with an order that divides 8: multiples of the group's order of any points."""
    found = {times(ORDER, point) for y in range(2, 60) for point in points_at(y)}
    assert {times(8, point) for point in found} == {(0, 1)}
    return found


def encodings(point: Point) -> set[bytes]:
    """All 32 bytes that a decoder may take for a point: y may be larger than the prime, -0 is 0."""
    x, y = point
    ys = [y] if y + PRIME >= 2**255 else [y, y + PRIME]
    signs = [0, 1] if x == 0 else [x & 1]
    return {(each | sign << 255).to_bytes(32, "little") for each in ys for sign in signs}


WEAK = sorted(encoding for point in small_order() for encoding in encodings(point))
FOR_ANY_MESSAGE = BASE_Y.to_bytes(32, "little") + (1).to_bytes(32, "little")
"""a signature that fits every message where the identity is the key: R = s B, for s = 1"""
NOT_CANONICAL = [(y | sign << 255).to_bytes(32, "little") for y in range(PRIME, 2**255) for sign in (0, 1)]


@pytest.mark.long
def test_there_are_eight_points_of_small_order_in_fourteen_encodings() -> None:
    assert (len(small_order()), len(WEAK), len(NOT_CANONICAL)) == (8, 14, 38)


def signature_part(key: bytes, signature: bytes) -> bytes:
    """A part of the right form with this key and signature."""
    der = bytes.fromhex("302a300506032b6570032100") + key
    said = {"algorithm": "Ed25519", "fingerprint": sha256_of(der), "public_key": key.hex()}
    return json.dumps({**said, "signature": signature.hex()}, indent=1).encode()


def signed_with(folder: Path, key: bytes, signature: bytes) -> Path:
    """A controller with this key and signature."""
    path = written(folder, content_of())
    path.write_bytes(pack_parts({**unpack_parts(path), SIGNATURE_PART: signature_part(key, signature)}))
    return path


@pytest.mark.parametrize("key", [*WEAK, *NOT_CANONICAL], ids=bytes.hex)
def test_a_weak_key_is_refused_in_a_file_and_as_signer(tmp_path: Path, key: bytes) -> None:
    path = signed_with(tmp_path, key, FOR_ANY_MESSAGE)
    assert refusal_message(path).startswith("controller it.unjam: it is signed by a weak Ed25519 key, ")
    public = tmp_path / "weak.pub"
    shown = Ed25519PublicKey.from_public_bytes(key).public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    public.write_bytes(shown)
    with pytest.raises(InputError, match=r"^signer: .*: a weak Ed25519 key, .* is not allowed; allowed: "):
        read_public_key(public)


def test_a_weak_key_would_sign_anything_without_that_check(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("unjam.controller.signature.is_weak_point", lambda point: False)
    identity = (1).to_bytes(32, "little")
    assert verify_controller_file(signed_with(tmp_path, identity, FOR_ANY_MESSAGE))


def test_a_weak_private_key_is_refused(tmp_path: Path, monkeypatch: Any) -> None:
    """No seed is known that has one; so every key counts as weak here."""
    made = make_keys(tmp_path / "maker")
    monkeypatch.setattr("unjam.controller.signature.is_weak_point", lambda point: True)
    with pytest.raises(InputError, match=r"^key: .*: a weak Ed25519 key, .* is not allowed; allowed: "):
        read_private_key(made.private)


@pytest.mark.parametrize("multiple", range(1, 16))
def test_a_malleable_signature_is_forged(tmp_path: Path, multiple: int) -> None:
    """s + k L is the same number in the group; only the smallest is a signature."""
    said = json.loads(unpack_parts(write_signed(tmp_path))[SIGNATURE_PART])
    key, signature = (bytes.fromhex(said[name]) for name in ("public_key", "signature"))
    s = int.from_bytes(signature[32:], "little") + multiple * ORDER
    if s < 2**256:
        other = signature[:32] + s.to_bytes(32, "little")
        assert refusal_message(signed_with(tmp_path, key, other)) == FORGED
    assert verify_controller_file(signed_with(tmp_path, key, signature))


@pytest.mark.parametrize("point", [*WEAK, *NOT_CANONICAL], ids=bytes.hex)
def test_a_signature_whose_point_is_weak_is_forged_whoever_checks_it(
    tmp_path: Path, point: bytes, monkeypatch: Any
) -> None:
    class Careless:
        """A key of a library that takes any signature."""

        from_public_bytes = staticmethod(lambda raw: Careless())

        def verify(self, signature: bytes, message: bytes) -> None:
            pass

        def public_bytes(self, encoding: Any, form: Any) -> bytes:
            return KEY.public_key().public_bytes(encoding, form)

    monkeypatch.setattr("unjam.controller.signature.Ed25519PublicKey", Careless)
    key = KEY.public_key().public_bytes_raw()
    honest = BASE_Y.to_bytes(32, "little")
    assert verify_controller_file(signed_with(tmp_path, key, honest + bytes(32)))
    assert refusal_message(signed_with(tmp_path, key, point + bytes(32))) == FORGED
    assert refusal_message(signed_with(tmp_path, key, honest + ORDER.to_bytes(32, "little"))) == FORGED


def test_with_a_signer_another_or_none_is_refused(tmp_path: Path) -> None:
    signer = public_file(tmp_path)
    other = fingerprint_of(OTHER.public_key())
    for content, how in (
        (write_signed(tmp_path, OTHER).read_bytes(), f"it is signed by another key, {other}"),
        (content_of(), "it is not signed"),
    ):
        with pytest.raises(InputError) as caught:
            verify_controller_file(written(tmp_path, content), signer)
        assert str(caught.value) == f"controller: {how}; allowed: signed by {str(signer)!r}, {FINGERPRINT}"


def test_a_signed_file_is_not_certified_again(tmp_path: Path) -> None:
    path = write_signed(tmp_path)
    before = path.read_bytes()
    with pytest.raises(InputError, match="allowed: one that is not: certify it first, then sign it"):
        add_certificate(path, read_controller(path), {})
    assert path.read_bytes() == before


def test_keys_are_read_as_they_were_made(tmp_path: Path) -> None:
    made = make_keys(tmp_path / "maker")
    assert (made.private, made.public) == (tmp_path / "maker.key", tmp_path / "maker.pub")
    assert read_public_key(made.public) == made.fingerprint
    assert fingerprint_of(read_private_key(made.private).public_key()) == made.fingerprint
    assert make_keys(tmp_path / "other").fingerprint != made.fingerprint


def test_a_private_key_is_its_owners_alone(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        made = make_keys(tmp_path / "maker")
    finally:
        os.umask(before)
    assert stat.S_IMODE(made.private.stat().st_mode) == 0o600
    assert stat.S_IMODE(made.public.stat().st_mode) == 0o644


@pytest.mark.parametrize("ending", [".key", ".pub"])
def test_files_that_are_there_are_not_written_over(tmp_path: Path, ending: str) -> None:
    (tmp_path / f"maker{ending}").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="a name without keys"):
        make_keys(tmp_path / "maker")
    assert [path.name for path in tmp_path.iterdir()] == [f"maker{ending}"]


def test_where_the_second_file_cannot_be_written_there_is_no_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        if len(list(tmp_path.iterdir())) == 2:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DiskError):
        make_keys(tmp_path / "maker")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["", ".", "/", "nowhere/maker"])
def test_a_name_of_no_files_is_refused(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises((InputError, DiskError)) as caught:
        make_keys(Path(name))
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def pem(key: Any, encryption: KeySerializationEncryption | None = None) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption or NoEncryption())


RSA = generate_private_key(65537, 2048)
NO_PRIVATE_KEYS = {
    "RSA": (pem(RSA), "is not allowed"),
    "encrypted": (pem(KEY, BestAvailableEncryption(b"secret")), "is encrypted"),
    "empty": (b"", "is not allowed"),
    "a public key": (KEY.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo), "is not allowed"),
    "DER": (KEY.private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption()), "is not allowed"),
    "cut": (pem(KEY)[:60], "is not allowed"),
    "torn": (pem(KEY).replace(b"MC4CAQ", b"MC4CAR"), "is not allowed"),
    "too large": (pem(KEY) + b"\n" * 20_000, "is not allowed"),
}


@pytest.mark.parametrize("name", NO_PRIVATE_KEYS)
def test_what_is_no_private_key_is_refused(tmp_path: Path, name: str) -> None:
    content, words = NO_PRIVATE_KEYS[name]
    (tmp_path / "maker.key").write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_private_key(tmp_path / "maker.key")
    path = str(tmp_path / "maker.key")
    allowed = "an Ed25519 private key in PEM without a password, as `unjam keys` writes it"
    assert str(caught.value) == f"key: {path!r} {words}; allowed: {allowed}"


@pytest.mark.parametrize(
    "content",
    [b"", pem(KEY), RSA.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo), b"\xff" * 99],
)
def test_what_is_no_public_key_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "maker.pub").write_bytes(content)
    with pytest.raises(InputError, match=r"^signer: .* is not allowed; allowed: an Ed25519 public key in PEM"):
        read_public_key(tmp_path / "maker.pub")


def test_a_pipe_a_folder_or_nothing_is_no_key(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, words in (("pipe", "is not allowed"), (".", "is not allowed"), ("none", "does not exist")):
        for read in (read_private_key, read_public_key):
            with pytest.raises(InputError, match=words):
                read(tmp_path / name)


@pytest.mark.skipif(not os.path.exists("/proc/self/mem"), reason="there is no such file")
def test_a_special_file_that_cannot_be_read_is_no_key() -> None:
    with pytest.raises(InputError, match="'/proc/self/mem' cannot be read: "):
        read_private_key(Path("/proc/self/mem"))


def test_only_signatures_need_what_checks_them(tmp_path: Path) -> None:
    write_signed(tmp_path)
    (tmp_path / "cryptography.py").write_text("raise ImportError('gone')")
    program = "import sys\nfrom unjam.controller import load_controller\nload_controller(sys.argv[1])\n"
    command = [sys.executable, "-c", program]
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}

    def run(path: Path) -> "subprocess.CompletedProcess[str]":
        words = [*command, str(path)]
        return subprocess.run(words, capture_output=True, text=True, env=environment, check=False)

    assert run(packaged_file("ring-best")).returncode == 0
    ran = run(tmp_path / "it.unjam")
    assert "MissingPartError: cryptography cannot be imported (gone)" in ran.stderr
    assert "pip install 'unjam[sign]'" in ran.stderr

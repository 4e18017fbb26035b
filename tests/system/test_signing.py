"""Sign a controller and verify its signature on the command line."""

import json
import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from tests.controller.test_signature import FORGED, NO_PRIVATE_KEYS, forge
from tests.controller.test_verify import content_of
from tests.system.conftest import ROOT, Run
from tests.system.test_invalid_inputs import one_line
from unjam.controller.file import WEIGHTS_PART, pack_parts, unpack_parts

DRIVE = ("drive", "ring", "--set", "horizon=5", "--set", "warmup=0", "-n", "1", "--no-report", "--driver")


@pytest.fixture
def maker(unjam: Run, tmp_path: Path) -> str:
    """Return the fingerprint of `maker.pub`; its private key and a controller are in the same folder."""
    (tmp_path / "it.unjam").write_bytes(content_of())
    return json.loads(unjam("keys", "maker", "--json").stdout)["fingerprint"]


def refusal_message(unjam: Run, *words: str) -> str:
    ran = unjam(*words)
    assert (ran.returncode, ran.stdout) == (2, ""), ran.stderr
    assert one_line(ran.stderr), ran.stderr
    return ran.stderr


def test_a_signed_controller_is_verified_and_drives(unjam: Run, tmp_path: Path, maker: str) -> None:
    plain = json.loads(unjam("verify", "it.unjam", "--json").stdout)
    assert (plain["signed_by"], plain["signer"]) == (None, None)
    ran = unjam("sign", "it.unjam", "--key", "maker.key")
    assert (ran.stdout, ran.stderr) == (f"it.unjam: signed by {maker}\n", "")
    verified = json.loads(unjam("verify", "it.unjam", "--json").stdout)
    assert (verified["ok"], verified["signed_by"], verified["signer"]) == (True, maker, None)
    verified = json.loads(unjam("verify", "it.unjam", "--signer", "maker.pub", "--json").stdout)
    assert (verified["ok"], verified["signed_by"], verified["signer"]) == (True, maker, "maker.pub")
    (line,) = [
        line
        for line in unjam("verify", "it.unjam", "--signer", "maker.pub").stdout.splitlines()
        if line.startswith("checked signature: ")
    ]
    assert ", by 'maker.pub', the key " in line
    assert unjam(*DRIVE, "it.unjam").returncode == 0


def test_the_documented_check_without_unjam_agrees(unjam: Run, tmp_path: Path, maker: str) -> None:
    assert unjam("sign", "it.unjam", "--key", "maker.key").returncode == 0
    (tmp_path / "it.unjam").rename(tmp_path / "ring.unjam")
    page = (ROOT / "docs/controller.md").read_text()
    (program,) = re.findall(r"```python\n((?:(?!```).)*maker\.verify.*?)```", page, re.DOTALL)

    def run() -> "subprocess.CompletedProcess[str]":
        command = [sys.executable, "-c", program]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    assert run().returncode == 0
    assert unjam("keys", "other").returncode == 0
    (tmp_path / "other.pub").replace(tmp_path / "maker.pub")
    assert "InvalidSignature" in run().stderr


def test_a_missing_signature_is_refused_if_a_signer_is_required(unjam: Run, maker: str) -> None:
    assert "it is not signed" in refusal_message(unjam, "verify", "it.unjam", "--signer", "maker.pub")
    assert unjam("verify", "it.unjam").returncode == 0


@pytest.mark.parametrize("command", ["drive", "verify", "certify", "export", "sign"])
def test_a_forged_controller_is_refused(command: str, unjam: Run, tmp_path: Path, maker: str) -> None:
    assert unjam("sign", "it.unjam", "--key", "maker.key").returncode == 0
    path = tmp_path / "it.unjam"
    parts = unpack_parts(path)
    changed = {**parts, WEIGHTS_PART: parts[WEIGHTS_PART][:-1] + b"?"}
    words = {
        "drive": (*DRIVE, "it.unjam"),
        "verify": ("verify", "it.unjam"),
        "certify": ("certify", "it.unjam"),
        "export": ("export", "it.unjam", "--out", "other.unjam"),
        "sign": ("sign", "it.unjam", "--key", "maker.key", "--replace"),
    }[command]
    for content, reason in ((forge(changed), FORGED), (pack_parts(changed), "controller it.unjam: damaged: ")):
        path.write_bytes(content)
        assert reason in refusal_message(unjam, *words)
        assert path.read_bytes() == content
    assert sorted(each.name for each in tmp_path.iterdir()) == ["it.unjam", "maker.key", "maker.pub"]


def test_a_signed_file_is_not_certified(unjam: Run, tmp_path: Path, maker: str) -> None:
    assert unjam("sign", "it.unjam", "--key", "maker.key").returncode == 0
    before = (tmp_path / "it.unjam").read_bytes()
    words = f"a file that is signed (by {maker}) is not allowed; allowed: one that is not: certify it first"
    assert words in refusal_message(unjam, "certify", "it.unjam")
    assert (tmp_path / "it.unjam").read_bytes() == before
    assert not (tmp_path / "it.html").exists()


def test_a_certificate_does_not_replace_a_page_of_the_user(unjam: Run, tmp_path: Path, maker: str) -> None:
    page = tmp_path / "it.html"
    page.write_text("<title>Certificate: my notes</title>")
    before = (tmp_path / "it.unjam").read_bytes()
    assert "out: 'it.html' exists and is no certificate" in refusal_message(unjam, "certify", "it.unjam")
    assert page.read_text() == "<title>Certificate: my notes</title>"
    assert (tmp_path / "it.unjam").read_bytes() == before


def test_a_signature_of_another_key_is_replaced_only_on_demand(unjam: Run, maker: str) -> None:
    other = json.loads(unjam("keys", "other", "--json").stdout)["fingerprint"]
    assert unjam("sign", "it.unjam", "--key", "maker.key").returncode == 0
    assert unjam("sign", "it.unjam", "--key", "maker.key").returncode == 0
    assert f"(it is signed by {maker}); or --replace" in refusal_message(
        unjam, "sign", "it.unjam", "--key", "other.key"
    )
    ran = unjam("sign", "it.unjam", "--key", "other.key", "--replace", "--json")
    assert json.loads(ran.stdout) == {"file": "it.unjam", "fingerprint": other, "previous_fingerprint": maker}
    words = f"it is signed by another key, {other}; allowed: signed by 'maker.pub', {maker}"
    assert words in refusal_message(unjam, "verify", "it.unjam", "--signer", "maker.pub")


def test_existing_keys_are_not_overwritten(unjam: Run, tmp_path: Path, maker: str) -> None:
    before = (tmp_path / "maker.key").read_bytes()
    assert "name: 'maker' is not allowed; allowed: a name without keys: " in refusal_message(unjam, "keys", "maker")
    assert (tmp_path / "maker.key").read_bytes() == before
    assert stat.S_IMODE((tmp_path / "maker.key").stat().st_mode) == 0o600
    assert unjam("keys", "nowhere/maker").returncode == 74


@pytest.mark.parametrize("name", ["RSA", "encrypted", "a public key"])
@pytest.mark.usefixtures("maker")
def test_other_keys_are_refused(name: str, unjam: Run, tmp_path: Path) -> None:
    content, words = NO_PRIVATE_KEYS[name]
    (tmp_path / "other.key").write_bytes(content)
    before = (tmp_path / "it.unjam").read_bytes()
    assert f"key: 'other.key' {words}; allowed: an Ed25519" in refusal_message(
        unjam, "sign", "it.unjam", "--key", "other.key"
    )
    assert (tmp_path / "it.unjam").read_bytes() == before
    refusal_message(unjam, "verify", "it.unjam", "--signer", "other.key")
    refusal_message(unjam, "sign", ".", "--key", "maker.key")
    refusal_message(unjam, "sign", "maker.pub", "--key", "maker.key")


@pytest.mark.usefixtures("maker")
def test_a_key_that_others_can_read_is_noted(unjam: Run, tmp_path: Path) -> None:
    (tmp_path / "maker.key").chmod(0o640)
    ran = unjam("sign", "it.unjam", "--key", "maker.key")
    assert ran.returncode == 0
    assert ran.stderr == "note: other users of this machine can read maker.key: chmod 600\n"

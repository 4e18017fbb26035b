"""What a program asks of files of others."""

from pathlib import Path
from typing import Any

import pytest

import unjam
from tests.controller.test_verify import ABOUT, content_of
from unjam.controller import controller_bytes
from unjam.controller.file import add_signature, read_controller
from unjam.controller.signature import make_keys, read_private_key
from unjam.controller.verify import verify_controller_file
from unjam.drivers.user_driver import FileDriver
from unjam.errors import DiskError, InputError


@pytest.mark.long
def test_a_controller_is_verified_in_a_limited_process(tmp_path: Path) -> None:
    path = tmp_path / "it.unjam"
    path.write_bytes(content_of())
    assert unjam.verify_controller(path) == verify_controller_file(path)
    path.write_bytes(content_of()[:-5])
    with pytest.raises(InputError, match=r"^controller it\.unjam: "):
        unjam.verify_controller(path)


@pytest.mark.long
def test_code_that_a_folder_names_runs_only_if_it_is_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = tmp_path / "code.py"
    code.write_text("def gentle(state):\n    return 0.1 * (state.leader_speed - state.speed)\n")
    (tmp_path / "controller.unjam").write_bytes(controller_bytes(FileDriver(code, "gentle"), ABOUT))
    monkeypatch.setenv("UNJAM_STATE", str(tmp_path / "of another user"))
    with pytest.raises(InputError, match="it runs only with --trust-code"):
        unjam.verify_controller(tmp_path)
    found = unjam.verify_controller(tmp_path, trust_code=True)
    assert [each.status for each in found if each.part == "code"] == ["checked"]


def test_a_key_is_never_taken_for_trust(tmp_path: Path) -> None:
    path: Any = tmp_path / "it.unjam"
    path.write_bytes(content_of())
    verify: Any = unjam.verify_controller
    with pytest.raises(TypeError):
        verify(path, "maker.pub")
    with pytest.raises(InputError, match=r"trust_code: 'maker\.pub' is not allowed; allowed: True or False"):
        verify(path, trust_code="maker.pub")
    with pytest.raises(InputError, match="signer: True is not allowed; allowed: the file of a public key"):
        verify(path, signer=True)


@pytest.mark.long
def test_the_signer_of_a_controller_is_checked_in_a_limited_process(tmp_path: Path) -> None:
    path, made = tmp_path / "it.unjam", make_keys(tmp_path / "maker")
    path.write_bytes(content_of())
    with pytest.raises(InputError, match=r"^controller: it is not signed; allowed: signed by "):
        unjam.verify_controller(path, signer=made.public)
    add_signature(path, read_controller(path), read_private_key(made.private))
    assert unjam.verify_controller(path, signer=made.public) == verify_controller_file(path, made.public)
    with pytest.raises(InputError, match=r"^signer: '--none' does not exist"):
        unjam.verify_controller(path, signer="--none")


@pytest.mark.long
@pytest.mark.usefixtures("without_pictures")
def test_a_report_is_written_in_a_limited_process(tmp_path: Path) -> None:
    run = tmp_path / "run"
    unjam.drive("ring", "pi", 1, scenario_options={"horizon": 20, "warmup": 0}, workers=1, out=run)
    assert unjam.write_report([run], run / "again.html") == run / "again.html"
    assert (run / "again.html").stat().st_size > 10_000
    with pytest.raises(DiskError, match="no such folder"):
        unjam.write_report([run], run / "nowhere" / "again.html")

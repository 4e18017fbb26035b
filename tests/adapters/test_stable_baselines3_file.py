import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import TQC, TRPO, RecurrentPPO
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3

import unjam
from tests.adapters.test_stable_baselines3 import Space
from unjam.adapters import policy_driver
from unjam.controller import make_driver
from unjam.drivers.check import random_state
from unjam.drivers.pi_saturation import PISaturation
from unjam.errors import InputError


def save(model: Any, folder: Path) -> Path:
    model.save(folder / "model.zip")
    return folder / "model.zip"


def change(file: Path, **parts: Callable[[bytes], bytes]) -> None:
    with zipfile.ZipFile(file) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, parts.get(name.replace(".", "_"), bytes)(content))


@pytest.mark.parametrize(
    ("algorithm", "options"),
    [
        *((each, {}) for each in (PPO, A2C, TRPO, SAC, TQC, TD3, DDPG)),
        (PPO, {"net_arch": {"pi": [8], "vf": [4, 4]}, "activation_fn": torch.nn.ReLU}),
        (SAC, {"net_arch": [8, 9, 10], "activation_fn": torch.nn.Tanh}),
        (PPO, {"net_arch": []}),
        (TD3, {"net_arch": []}),
        (PPO, {"use_sde": True}),
        (TRPO, {"use_sde": True, "squash_output": True}),
    ],
)
def test_a_file_drives_as_its_model(algorithm: Any, options: dict[str, Any], tmp_path: Path) -> None:
    space = Space(action=spaces.Box(-0.7, 1.5, (1,), np.float32))
    sde = {name: value for name, value in options.items() if name == "use_sde"}
    options = {name: value for name, value in options.items() if name != "use_sde"}
    model = algorithm("MlpPolicy", space, policy_kwargs=options, seed=1, device="cpu", **sde)
    read = policy_driver(save(model, tmp_path))
    unjam.check_driver(read)
    state = random_state(np.random.default_rng(0), 200)
    expected, _ = policy_driver(model).act(state, read.initial_memory(200))
    np.testing.assert_allclose(read.act(state, read.initial_memory(200))[0], expected, atol=2e-6)


def test_features_and_expert_are_given_in_python_and_local_features_by_name(tmp_path: Path) -> None:
    with_expert = save(PPO("MlpPolicy", Space(6), seed=1, device="cpu"), tmp_path)
    driver = policy_driver(with_expert, ("local", "expert_acceleration"), PISaturation())
    assert driver.describe() == "pi + model.zip"
    with pytest.raises(InputError, match=r"inputs: 5 numbers are not allowed; allowed: 6, the inputs of model\.zip"):
        make_driver(str(with_expert), 0.1)
    assert make_driver(str(save(PPO("MlpPolicy", Space(), device="cpu"), tmp_path)), 0.1).describe() == "model.zip"


def test_actions_are_held_for_the_time_step_of_the_policy(tmp_path: Path) -> None:
    file = save(PPO("MlpPolicy", Space(), seed=1, device="cpu"), tmp_path)
    held = make_driver(f"{file}:policy_time_step=0.2", 0.1)
    for driver, decisions in ((policy_driver(file), 5), (policy_driver(file, policy_time_step=0.2), 3), (held, 3)):
        states = random_state(np.random.default_rng(0), 5)
        memory, commands = driver.initial_memory(1), set[float]()
        for row in range(5):
            acceleration, memory = driver.act(states.select(slice(row, row + 1)), memory)
            commands.add(float(acceleration[0]))
        assert len(commands) == decisions
    with pytest.raises(InputError, match=r"time_step: 0\.25 is not allowed; allowed: multiples of the road"):
        policy_driver(file, policy_time_step=0.25)
    with pytest.raises(InputError, match=r"driver model\.zip: 'step' is not allowed; allowed: policy_time_step"):
        make_driver(f"{file}:step=0.2", 0.1)


def test_a_model_of_unjam_holds_its_actions_as_in_training(tmp_path: Path) -> None:
    model = PPO("MlpPolicy", Space(), seed=1, device="cpu")
    model.unjam = {"expert": "pi", "action_repeat": 4}  # pyright: ignore[reportAttributeAccessIssue]
    for policy in (model, save(model, tmp_path)):
        drivers = (
            policy_driver(policy, ("local",), PISaturation(), policy_time_step=step) for step in (None, 0.4, 0.1)
        )
        assert [driver.description.time_step for driver in drivers] == [0.4, 0.4, 0.1]


class Runs:
    """An object that creates a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> Any:
        return Path.touch, (self.file,)


def test_a_residual_is_refused_without_its_expert(tmp_path: Path) -> None:
    model = PPO("MlpPolicy", Space(), seed=1, device="cpu")
    model.unjam = {"expert": "pi"}  # pyright: ignore[reportAttributeAccessIssue]
    for policy in (model, save(model, tmp_path)):
        assert policy_driver(policy, expert=PISaturation()).describe().startswith("pi + ")
        with pytest.raises(InputError, match="it is a residual; allowed: policy_driver with its expert, 'pi'"):
            policy_driver(policy)


def test_nothing_in_a_file_is_executed(tmp_path: Path) -> None:
    trap = tmp_path / "executed"
    file = save(PPO("MlpPolicy", Space(), device="cpu"), tmp_path)
    content = io.BytesIO()
    torch.save({"action_net.weight": Runs(trap)}, content)
    change(file, policy_pth=lambda _: content.getvalue())
    with pytest.raises(InputError, match=r"driver model\.zip: UnpicklingError: "):
        policy_driver(file)
    assert not trap.exists()
    torch.load(io.BytesIO(content.getvalue()), weights_only=False)
    assert trap.exists()  # the trap works


def test_keys_of_nested_tuples_are_refused_before_torch_hashes_them(tmp_path: Path) -> None:
    file, content = save(PPO("MlpPolicy", Space(), device="cpu"), tmp_path), io.BytesIO()
    nested: Any = ()
    for _ in range(60):
        nested = (nested, nested)
    torch.save({"key": [nested]}, content)  # a key itself would never end here, either
    change(file, policy_pth=lambda _: content.getvalue())
    with pytest.raises(InputError, match=r"driver model\.zip: ValueError: a tuple occurs more than once"):
        policy_driver(file)


def test_a_pickle_of_millions_of_operations_is_refused_before_they_run(tmp_path: Path) -> None:
    file, content = save(PPO("MlpPolicy", Space(), device="cpu"), tmp_path), io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02](" + b"N" * 50_000_000 + b"e.")
    assert len(content.getvalue()) < 100_000
    change(file, policy_pth=lambda _: content.getvalue())
    with pytest.raises(InputError, match=r"driver model\.zip: ValueError: a pickle larger than 1,048,576 bytes"):
        policy_driver(file)


def test_parts_of_an_archive_are_read_up_to_a_common_limit(tmp_path: Path) -> None:
    file, content = save(PPO("MlpPolicy", Space(), device="cpu"), tmp_path), io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("archive/data.pkl", bytes(1000))
    change(file, policy_pth=lambda _: content.getvalue())
    with pytest.raises(InputError, match=r"'archive/data\.pkl' is compressed by another method than deflate"):
        policy_driver(file)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(3):
            archive.writestr(f"archive/{number}", bytes(30_000_000))
    change(file, policy_pth=lambda _: content.getvalue())
    with pytest.raises(InputError, match="ValueError: larger than 67108864 bytes"):
        policy_driver(file)


def test_serialized_parts_of_the_data_are_not_read(tmp_path: Path) -> None:
    file = save(PPO("MlpPolicy", Space(), device="cpu"), tmp_path)

    def spoil(content: bytes) -> bytes:
        data = json.loads(content)
        for entry in data.values():
            if isinstance(entry, dict) and ":serialized:" in entry:
                entry[":serialized:"] = "not a pickle"
        return json.dumps(data).encode()

    change(file, data=spoil)
    unjam.check_driver(policy_driver(file))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: DQN("MlpPolicy", Space(action=spaces.Discrete(3)), device="cpu"), "Discrete.* is not a Box"),
        (lambda: RecurrentPPO("MlpLstmPolicy", Space(), device="cpu"), "its weights are not those of an MlpPolicy"),
        (lambda: PPO("MlpPolicy", Space(action=2), device="cpu"), "its actions are not one number"),
        (lambda: SAC("MlpPolicy", Space(), use_sde=True, device="cpu"), "its weights are not those"),
        (
            lambda: PPO("MlpPolicy", Space(), policy_kwargs={"squash_output": 1}, use_sde=True, device="cpu"),
            "squash_output is neither true nor false",
        ),
        (
            lambda: PPO("MlpPolicy", Space(), policy_kwargs={"activation_fn": torch.nn.ELU}, device="cpu"),
            "activation ELU; known: Tanh, ReLU",
        ),
    ],
)
def test_other_models_are_refused_in_one_line(make: Callable[[], Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"^driver model\.zip: ValueError: .*{words}.*; allowed: ") as error:
        policy_driver(save(make(), tmp_path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "parts",
    [
        {"data": lambda content: b"{}"},
        {"data": lambda content: b"not JSON"},
        {"data": lambda content: content.replace(b'"[-1.]"', b'"[nothing]"')},
        {"policy_pth": lambda content: b""},
        {"policy_pth": lambda content: content[:-100]},
        {"data": lambda content: b" " * 65 * 2**20},
    ],
)
def test_damaged_files_are_refused_in_one_line(parts: Any, tmp_path: Path) -> None:
    file = save(PPO("MlpPolicy", Space(), device="cpu"), tmp_path)
    change(file, **parts)
    with pytest.raises(InputError, match=r"^driver model\.zip: \w+: ") as error:
        policy_driver(file)
    assert "\n" not in str(error.value)
    file.write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"driver model\.zip: BadZipFile: "):
        policy_driver(file)
    with pytest.raises(InputError, match=r"driver: '.*none\.zip' does not exist"):
        make_driver(str(tmp_path / "none.zip"), 0.1)

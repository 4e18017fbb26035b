"""Tests that the pinned kernels give the committed results; python -m tests.kernels.bless accepts others."""

import json
import os
import platform
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from tests.training.test_run import small_config
from unjam import kernels

ROOT = Path(__file__).parents[1]
GOLDEN = json.loads((ROOT / "tests/kernels/hashes.json").read_text())
UNPINNED = {
    "OPENBLAS_CORETYPE": "Sandybridge",
    "OPENBLAS_NUM_THREADS": "2",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "ATEN_CPU_CAPABILITY": "default",
    "MKL_CBWR": "AVX",
}
"""other kernels, which every processor with AVX2 has as well, and another core"""
AFFECTED_KINDS = {
    "OPENBLAS_CORETYPE": {"numpy products"},
    "OPENBLAS_NUM_THREADS": {"numpy products"},
    "NPY_DISABLE_CPU_FEATURES": {"numpy functions", "numpy sums"},
    "ATEN_CPU_CAPABILITY": {"torch functions", "torch sums", "torch products", "torch initialization", "torch steps"},
    "MKL_CBWR": {"torch functions", "torch products", "torch initialization", "torch steps"},
}
"""kinds of operations that each variable may change"""

needs_avx2 = pytest.mark.skipif(
    not kernels.has_pinned_kernels(), reason=f"not pinned: {kernels.kernel_info()['unpinned_reason']}"
)


def run(program: str, **variables: str) -> dict[str, Any]:
    """Return the JSON that a program prints last, in its own process with these variables."""
    inherited = {name: value for name, value in os.environ.items() if name not in kernels.KERNEL_SETTINGS}
    completed = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env={**inherited, **variables},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert "Warning" not in completed.stderr
    return json.loads(completed.stdout.splitlines()[-1])


OPERATIONS = "import unjam, json; from tests.kernels import operations; print(json.dumps(operations.hashes()))"
STATE = "import {first}, json; import unjam; from unjam.kernels import kernel_info; print(json.dumps(kernel_info()))"


@pytest.mark.long
@needs_avx2
def test_results_equal_the_committed_ones_in_any_environment() -> None:
    assert run(OPERATIONS, **UNPINNED) == GOLDEN["operations"]


@pytest.mark.slow
@needs_avx2
@pytest.mark.parametrize("variable", UNPINNED)
def test_each_variable_changes_only_its_kinds(variable: str) -> None:
    varied = {**kernels.kernel_settings(), variable: UNPINNED[variable], kernels.KERNELS_VARIABLE: "native"}
    found = run(OPERATIONS, **varied)
    changed_kinds = {kind for kind, value in found.items() if value != GOLDEN["operations"][kind]}
    assert changed_kinds <= AFFECTED_KINDS[variable]
    intel, cores = kernels.processor_info()["vendor_id"] == "GenuineIntel", os.cpu_count() or 1
    has_effect = {"MKL_CBWR": intel, "OPENBLAS_NUM_THREADS": cores > 1}  # on others MKL has only COMPATIBLE
    assert changed_kinds or not has_effect.get(variable, True)


@pytest.mark.long
@needs_avx2
def test_trainings_of_all_learners_end_with_the_committed_bits() -> None:
    program = (
        "import json, sys; from tests.kernels import trainings; "
        "found = trainings.hashes(list(trainings.LEARNERS)); "
        "assert 'torch._dynamo' not in sys.modules, 'its import takes seconds'; "
        "print(json.dumps(found))"
    )
    assert run(program, **UNPINNED) == GOLDEN["trainings"]


@pytest.mark.long
@needs_avx2
def test_kernel_info_describes_the_active_kernels() -> None:
    found = run(STATE.format(first="unjam, torch"))
    assert found["pinned"]
    assert found["unpinned_reason"] is None
    assert (found["openblas"], found["torch"]) == ("Haswell", "AVX2")
    assert not [name for name in found["numpy"] if "512" in name or name == "X86_V4"]
    assert found["settings"] == kernels.kernel_settings()
    assert found["processor"]


@needs_avx2
def test_kernel_info_reports_that_numpy_was_imported_first() -> None:
    found = run(STATE.format(first="numpy"))
    assert not found["pinned"]
    assert found["unpinned_reason"] == "numpy was imported before unjam"
    assert run(STATE.format(first="numpy"), **kernels.kernel_settings())["pinned"]


def test_native_kernels_change_no_variable() -> None:
    found = run(STATE.format(first="unjam"), **{kernels.KERNELS_VARIABLE: "native"})
    assert not found["pinned"]
    assert set(found["settings"].values()) == {None}


@pytest.mark.parametrize(
    ("machine", "flags", "words"), [("aarch64", "asimd", "not x86-64"), ("x86_64", "sse2 avx", "no AVX2")]
)
def test_other_processors_are_not_pinned(machine: str, flags: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(kernels, "processor_info", lambda: {"flags": flags})
    assert words in (kernels._find_obstacle() or "")


LATE = """
import numpy, json, sys
import unjam
from unjam.errors import InputError
from unjam.training.config import RunConfig
from unjam.kernels import has_pinned_kernels
from unjam.parameters import build_dataclass
assert not has_pinned_kernels()
values, folder = json.loads({given!r})
rows, evaluated = [], []
config = build_dataclass(RunConfig, values, "")

def stop_after_first(row):
    rows.append(row)
    return False

result = unjam.train(config, folder, on_iteration=stop_after_first, progress=lambda *each: evaluated.append(each))
print(json.dumps([[row["iteration"] for row in rows], len(evaluated) > 0, result.gain.count]))
"""
REFUSED = """
try:
    unjam.train(build_dataclass(RunConfig, values, ""), folder)
except InputError as error:
    print(json.dumps(str(error)))
"""


@pytest.mark.slow
@needs_avx2
def test_errors_of_the_pinned_process_are_reported(tmp_path: Path) -> None:
    (tmp_path / "something").touch()
    program = LATE.partition("config = ")[0] + REFUSED
    given = json.dumps([asdict(small_config()), str(tmp_path)])
    assert "is not empty" in run(program.format(given=given))


@needs_avx2
@pytest.mark.slow
def test_program_that_imported_numpy_first_trains_in_a_pinned_process(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    given = json.dumps([asdict(small_config(steps=900)), str(folder)])
    iterations, has_evaluated, count = run(LATE.format(given=given))
    assert (iterations, has_evaluated, count) == ([1], True, 2)
    assert json.loads((folder / "manifest.json").read_text())["kernels"]["pinned"]

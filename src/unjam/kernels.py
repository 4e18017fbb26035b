"""Select kernels of NumPy and torch that compute the same bits on every x86-64 machine with AVX2.

Kernels round differently. `pin_kernels` selects kernels that every processor with AVX2 has, before NumPy is imported;
with `UNJAM_KERNELS=native` it changes nothing. docs/training.md lists the processors that were tested.

Square roots of MKL depend on the maker of the processor in every mode. Therefore Adam is fused, and
`unjam.physics.arrays` computes square roots of tensors.
"""

import ctypes
import os
import platform
import sys
import warnings
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from itertools import takewhile
from pathlib import Path
from typing import Any

KERNELS_VARIABLE = "UNJAM_KERNELS"
KERNEL_SETTINGS = {
    "OPENBLAS_CORETYPE": "Haswell",
    # With several threads, products of thousands of rows depend on the number of cores; small products become slower.
    "OPENBLAS_NUM_THREADS": "1",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "ATEN_CPU_CAPABILITY": "avx2",
    # AVX2 has an effect only on processors of Intel: on others MKL silently uses COMPATIBLE.
    "MKL_CBWR": "COMPATIBLE",
}
"""environment variables for products of NumPy and their threads, functions of NumPy, functions of torch, and MKL"""
OLD_NUMPY_FEATURES = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
"""value of NPY_DISABLE_CPU_FEATURES for NumPy before 2.4"""
KERNEL_LIBRARIES = ("numpy", "torch")


def pin_kernels() -> None:
    """Set the environment variables that select the kernels, for this process and its children."""
    global _unpinned_reason
    requested = os.environ.get(KERNELS_VARIABLE, "")
    if requested not in ("", "native"):
        warnings.warn(f"{KERNELS_VARIABLE}: {requested!r} has no effect; allowed: native", stacklevel=2)
    _unpinned_reason = _find_obstacle()
    if _unpinned_reason is None:
        settings = kernel_settings()
        loaded = [name for name in KERNEL_LIBRARIES if name in sys.modules]
        if loaded and any(os.environ.get(name) != value for name, value in settings.items()):
            _unpinned_reason = f"{loaded[0]} was imported before unjam"
        os.environ.update(settings)


def has_pinned_kernels() -> bool:
    """Return whether this process computes with the pinned kernels."""
    return _unpinned_reason is None


def needs_new_process() -> bool:
    """Return whether only a new process can have the pinned kernels."""
    return _unpinned_reason is not None and _find_obstacle() is None


def kernel_settings() -> dict[str, str]:
    """Return the environment variables for the installed version of NumPy, which warns of unknown features."""
    with suppress(PackageNotFoundError, ValueError):
        if tuple(map(int, version("numpy").split(".")[:2])) < (2, 4):
            return {**KERNEL_SETTINGS, "NPY_DISABLE_CPU_FEATURES": OLD_NUMPY_FEATURES}
    return KERNEL_SETTINGS


def kernel_info() -> dict[str, Any]:
    """Return the processor and the active kernels of the loaded libraries, for manifests."""
    numpy, torch = (sys.modules.get(name) for name in KERNEL_LIBRARIES)
    umath = sys.modules["numpy._core._multiarray_umath"] if numpy else None
    return {
        "processor": processor_info().get("model name", platform.processor() or platform.machine()),
        "pinned": has_pinned_kernels(),
        "unpinned_reason": _unpinned_reason,
        "settings": {name: os.environ.get(name) for name in KERNEL_SETTINGS},
        "openblas": _openblas_core(numpy) if numpy else None,
        "numpy": [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__.get(name)] if umath else None,
        "torch": torch.backends.cpu.get_cpu_capability() if torch else None,
    }


def processor_info() -> dict[str, str]:
    """Return the description of the first processor by Linux; empty on other systems."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
        entries = (line.partition(":") for line in takewhile(lambda line: ":" in line, lines))
        return {name.strip(): value.strip() for name, _, value in entries}
    return {}


def _find_obstacle() -> str | None:
    """Return the reason why this machine cannot pin kernels; None if it can."""
    if os.environ.get(KERNELS_VARIABLE) == "native":
        return f"{KERNELS_VARIABLE}=native"
    if platform.machine() not in ("x86_64", "AMD64"):
        return f"the processor is not x86-64: {platform.machine()}"
    if not {"avx2", "fma"} <= set(processor_info().get("flags", "").split()):
        return "the processor has no AVX2, or does not say so"
    return None


def _openblas_core(numpy: Any) -> str | None:
    """Return the processor type for which the OpenBLAS in NumPy has selected kernels; None: another BLAS."""
    for library in (Path(numpy.__file__).parents[1] / "numpy.libs").glob("libscipy_openblas64_*"):
        with suppress(OSError, AttributeError):
            core_name = ctypes.CDLL(str(library)).scipy_openblas_get_corename64_
            core_name.restype = ctypes.c_char_p
            return core_name().decode()
    return None


_unpinned_reason: str | None = "pin_kernels() was not called"

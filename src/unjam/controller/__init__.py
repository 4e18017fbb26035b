"""The controller as one file that can be shipped, and every way to name a driver.

A `.unjam` file is an uncompressed zip archive of a manifest in JSON (what it is, what it observes and
remembers, how its driver is made), weights in safetensors and, where it was exported, a recorded sample
and an ONNX graph. Nothing in it is ever executed.
"""

from unjam.controller.file import SUFFIX, controller_bytes, load_controller
from unjam.controller.naming import make_driver

__all__ = ["SUFFIX", "controller_bytes", "load_controller", "make_driver"]

"""Policies of other libraries as drivers."""

from unjam.adapters.onnx_file import onnx_driver
from unjam.adapters.policies import policy_driver
from unjam.drivers.observation import PolicyInput
from unjam.drivers.policy import PolicyDescription, PolicyMemory, PolicyOutput

__all__ = ["PolicyDescription", "PolicyInput", "PolicyMemory", "PolicyOutput", "onnx_driver", "policy_driver"]

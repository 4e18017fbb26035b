"""The arithmetic of trainings on fixed numbers: a short hash of the bits of each kind.

Run: python -m tests.kernels.operations; prints one JSON object. It also runs under an emulator of another
processor: qemu-x86_64 -cpu EPYC python -m tests.kernels.operations.
"""

import hashlib
import itertools
import json
import math
from collections.abc import Iterable

import numpy as np
import torch
from torch import nn

from unjam.adam import Adam

ROWS = (1, 3, 16, 64, 300, 2000)
"""of the products: one CAV, a batch, an iteration"""
SIZES = ((9, 64, 64, 1), (11, 32, 32, 6), (6, 8, 1))
"""of the networks: inputs, hidden layers, outputs"""
LENGTHS = (1, 7, 64, 5000)
"""of the arguments of functions"""


def numbers(*shape: int, low: float = -1.0, high: float = 1.0) -> np.ndarray:
    """Return numbers that depend on their shape alone, without using a function of a kernel library."""
    generator = np.random.default_rng([20, *shape])
    return low + (high - low) * generator.random(shape)


def numpy_products() -> list[np.ndarray]:
    """Return products as in the network of workers: rows by a matrix, a row by a matrix, a vector."""
    found = []
    for sizes, rows in itertools.product(SIZES, ROWS[:5]):
        hidden = numbers(rows, sizes[0])
        for inputs, outputs in itertools.pairwise(sizes):
            hidden = np.maximum(hidden.dot(numbers(inputs, outputs) / math.sqrt(inputs)), 0.0)
            found.append(hidden)
            found.append(hidden[0].dot(numbers(outputs, 3)))
    return found


def numpy_functions() -> list[np.ndarray]:
    found = []
    for length in LENGTHS:
        small, positive = numbers(length, low=-8.0, high=8.0), numbers(length, low=1e-3, high=50.0)
        found += [np.exp(small), np.tanh(small), np.log(positive), np.sqrt(positive), positive**4, positive**0.7]
        found += [np.sin(small), np.cos(small), np.square(small)]
        found += [each.astype(np.float32) for each in (np.exp(np.float32(small)), np.tanh(np.float32(small)))]
    return found


def numpy_sums() -> list[np.ndarray]:
    found = []
    for length in LENGTHS:
        values = numbers(length, 5)
        found += [values.sum(0), values.sum(1), values.mean(), values.std(0), np.percentile(values, 37.0)]
    return [np.asarray(each) for each in found]


def plain_functions() -> list[np.ndarray]:
    """Return functions that plain Python takes from the C library."""
    values = numbers(200, low=-5.0, high=5.0).tolist()
    functions = (math.exp, math.sin, math.cos, math.tanh, math.tan, math.atan, math.erf)
    return [np.array([function(value) for value in values]) for function in functions] + [
        np.array([math.log(abs(value)) + abs(value) ** 0.7 + math.hypot(value, 1.0) for value in values])
    ]


def torch_functions() -> list[torch.Tensor]:
    found = []
    for length, kind in itertools.product(LENGTHS, (torch.float32, torch.float64)):
        small = torch.as_tensor(numbers(length, low=-8.0, high=8.0)).to(kind)
        positive = torch.as_tensor(numbers(length, low=1e-3, high=50.0)).to(kind)
        found += [small.exp(), small.tanh(), torch.erf(small), torch.sigmoid(small), small.sin(), small.cos()]
        found += [positive.log(), positive.rsqrt().reciprocal(), positive**4, positive**0.7, 1.0 / positive]
        found += [nn.functional.softplus(small), small.square(), positive.log1p()]
    return found


def torch_sums() -> list[torch.Tensor]:
    found = []
    for length, kind in itertools.product(LENGTHS, (torch.float32, torch.float64)):
        values = torch.as_tensor(numbers(length, 5)).to(kind)
        found += [values.sum(0), values.sum(1), values.mean(), values.norm(), values.cumsum(0)]
        if length > 1:
            found += [values.std(0), values.var(), nn.functional.layer_norm(values, (5,))]
    return found


def torch_products() -> list[torch.Tensor]:
    """Return products of the learners' networks and of their gradients, plain and of the whole ensemble at once."""
    found = []
    for sizes, rows in itertools.product(SIZES, ROWS):
        hidden = torch.as_tensor(numbers(rows, sizes[0])).float()
        members = torch.as_tensor(numbers(5, rows, sizes[0])).float()
        for inputs, outputs in itertools.pairwise(sizes):
            scale = math.sqrt(inputs)
            weight = torch.as_tensor(numbers(outputs, inputs) / scale).float().requires_grad_()
            bias = torch.as_tensor(numbers(outputs)).float().requires_grad_()
            weights = torch.as_tensor(numbers(5, inputs, outputs) / scale).float().requires_grad_()
            biases = torch.as_tensor(numbers(5, 1, outputs)).float().requires_grad_()
            hidden = nn.functional.linear(hidden, weight, bias)
            members = torch.baddbmm(biases, members, weights)
            loss = hidden.square().mean() + members.square().mean((1, 2)).sum()
            gradients = torch.autograd.grad(loss, [weight, bias, weights, biases])
            found += [hidden, members, *gradients]
            flat = gradients[0].reshape(-1)
            found += [torch.matmul(flat, flat), torch.addmm(bias, hidden.detach() @ weight, weight.T)]
            hidden, members = hidden.detach().relu_(), members.detach().relu_()
    return found


def torch_initialization() -> list[torch.Tensor]:
    """Return what initializes networks: random numbers, and orthogonal weights from LAPACK."""
    generator = torch.Generator().manual_seed(20)
    found = [torch.randn(count, generator=generator) for count in (5, 16, 4096)]
    for rows, columns in ((64, 9), (64, 64), (8, 6), (1, 64)):
        q, r = torch.linalg.qr(torch.as_tensor(numbers(max(rows, columns), min(rows, columns))).float())
        found += [q, r]
    return found


def torch_steps() -> list[torch.Tensor]:
    """Return the result of 20 steps of fused Adam, as in trainings; other variants take square roots from MKL."""
    parameter = torch.as_tensor(numbers(64, 9)).float().requires_grad_()
    optimizer = Adam([parameter], lr=1e-3, fused=True)
    for step in range(20):
        parameter.grad = torch.as_tensor(numbers(64, 9, low=-1.0 - step)).float() * parameter.detach()
        optimizer.step()
    return [parameter]


KINDS = {
    "numpy products": numpy_products,
    "numpy functions": numpy_functions,
    "numpy sums": numpy_sums,
    "plain functions": plain_functions,
    "torch functions": torch_functions,
    "torch sums": torch_sums,
    "torch products": torch_products,
    "torch initialization": torch_initialization,
    "torch steps": torch_steps,
}


def hashes(kinds: Iterable[str] = KINDS) -> dict[str, str]:
    """Return the hash of all results, by kind."""
    torch.set_num_threads(1)
    found = {}
    for kind in kinds:
        total = hashlib.sha256()
        for each in KINDS[kind]():
            array = each.detach().numpy() if isinstance(each, torch.Tensor) else each
            total.update(np.ascontiguousarray(array).tobytes())
        found[kind] = total.hexdigest()[:16]
    return found


if __name__ == "__main__":
    print(json.dumps(hashes(), indent=1))

"""Adam, without what torch would load to compile it."""

from collections.abc import Callable
from inspect import unwrap
from typing import Any, cast

import torch

_adam = torch.optim.Adam


class Adam(_adam):
    """torch's Adam, the same to the bit, without torch's compiler: a second of each process that learns.

    What torch's own methods are wrapped in loads it, to tell it not to compile them. Not for `torch.compile`.
    """

    add_param_group = cast(Callable[..., None], unwrap(_adam.add_param_group))
    zero_grad = cast(Callable[..., None], unwrap(_adam.zero_grad))
    state_dict = cast(Callable[..., dict[str, Any]], unwrap(_adam.state_dict))
    load_state_dict = cast(Callable[..., None], unwrap(_adam.load_state_dict))
    step = torch.no_grad()(unwrap(_adam.step))

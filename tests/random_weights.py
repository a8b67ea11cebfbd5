"""Weights drawn at random, so that a test of a module's equations does not depend on how the module begins."""

import math
from typing import TypeVar

import torch
from torch import nn

M = TypeVar("M", bound=nn.Module)


def randomise(module: M, seed: int = 0, scale: float = 1.0) -> M:
    """Every parameter normal, with a spread that keeps the size of activations; vectors and scalars around 0."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            inputs = parameter[0].numel() if parameter.dim() > 1 else 4
            parameter.normal_(0, scale / math.sqrt(inputs), generator=generator)
    return module

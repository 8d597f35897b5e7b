# pyright: basic, reportMissingImports=false
# PyTorch is in image `learn` only.
"""words: says which of a few words is spoken. A convolutional network on log-mel spectra (Sainath and Parada 2015).

Input (batch, 1, 98, 40): one second. GroupNorm, as in `clips`.
"""

from itertools import pairwise

import torch
from torch import nn

WIDTHS = (1, 16, 32, 64, 96)
GROUPS = 4


class Words(nn.Module):
    """The network."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(
            nn.Conv2d(low, high, 3, stride=2, padding=1, bias=False) for low, high in pairwise(WIDTHS)
        )
        self.norms = nn.ModuleList(nn.GroupNorm(GROUPS, high) for high in WIDTHS[1:])
        self.head = nn.Linear(WIDTHS[-1], classes)

    def forward(self, spectra: torch.Tensor) -> torch.Tensor:
        """Return the scores, (batch, classes)."""
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            spectra = torch.relu(norm(convolution(spectra)))
        return self.head(spectra.mean(dim=(2, 3)))


def build(classes: int) -> nn.Module:
    """Return the network for so many classes."""
    return Words(classes)

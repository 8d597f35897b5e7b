# pyright: basic, reportMissingImports=false
# PyTorch is in image `learn` only.
"""clips: says what is done in a video clip. A 3-D convolutional network (Tran et al. 2015), small, with GroupNorm.

Input (batch, 1, 16, 40, 40): 16 grey pictures spread over the clip. GroupNorm (Wu and He 2018) keeps no running
statistics, which clients with different data could not share. 73,682 parameters for 10 classes.
"""

from itertools import pairwise

import torch
from torch import nn

WIDTH = 8
GROUPS = 4


class Clips(nn.Module):
    """The network: `features` of a clip, and `head` that scores each class."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        widths = (1, WIDTH, 2 * WIDTH, 4 * WIDTH, 8 * WIDTH)
        strides = ((1, 2, 2), 2, 2, 1)
        self.convolutions = nn.ModuleList(
            nn.Conv3d(low, high, 3, stride=stride, padding=1, bias=False)
            for (low, high), stride in zip(pairwise(widths), strides, strict=True)
        )
        self.norms = nn.ModuleList(nn.GroupNorm(GROUPS, high) for high in widths[1:])
        self.head = nn.Linear(widths[-1], classes)

    def features(self, clips: torch.Tensor) -> torch.Tensor:
        """Return (batch, 64) of clips (batch, 1, 16, 40, 40)."""
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            clips = torch.relu(norm(convolution(clips)))
        return clips.mean(dim=(2, 3, 4))

    def forward(self, clips: torch.Tensor) -> torch.Tensor:
        """Return the scores, (batch, classes)."""
        return self.head(self.features(clips))


def build(classes: int) -> nn.Module:
    """Return the network for so many classes."""
    return Clips(classes)

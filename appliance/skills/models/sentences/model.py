# pyright: basic, reportMissingImports=false
# PyTorch is in image `learn` only.
"""sentences: writes down what is said. Dilated convolutions over log-mel frames with CTC (Graves et al. 2006).

Input (batch, frames, 40); output (frames/2, batch, symbols) log-probabilities, of which the first is CTC's blank. Eight
residual layers see 4 s around each frame.
"""

import torch
from torch import nn

BANDS = 40
WIDTH = 128
DILATIONS = (1, 2, 4, 8, 1, 2, 4, 8)
KERNEL = 3
GROUPS = 8


class Sentences(nn.Module):
    """The network."""

    def __init__(self, symbols: int) -> None:
        super().__init__()
        self.entry = nn.Conv1d(BANDS, WIDTH, 5, stride=2, padding=2, bias=False)
        self.entry_norm = nn.GroupNorm(GROUPS, WIDTH)
        self.layers = nn.ModuleList(
            nn.Conv1d(WIDTH, WIDTH, KERNEL, padding=dilation * (KERNEL // 2), dilation=dilation, bias=False)
            for dilation in DILATIONS
        )
        self.norms = nn.ModuleList(nn.GroupNorm(GROUPS, WIDTH) for _ in DILATIONS)
        self.head = nn.Linear(WIDTH, symbols)

    def forward(self, spectra: torch.Tensor) -> torch.Tensor:
        """Return log-probabilities of symbols, (frames, batch, symbols)."""
        found = torch.relu(self.entry_norm(self.entry(spectra.transpose(1, 2))))
        for layer, norm in zip(self.layers, self.norms, strict=True):
            found = found + torch.relu(norm(layer(found)))
        return torch.log_softmax(self.head(found.permute(2, 0, 1)), dim=2)


def build(classes: int) -> nn.Module:
    """Return the network for so many symbols, the blank among them."""
    return Sentences(classes)

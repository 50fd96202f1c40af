"""The mean of a field's parameters over the last steps of a fit, which is kept in place of the last."""

import torch
from torch import Tensor

from nerfdiff.fit.refined_field import RefinedField


class WeightAverage:
    """Average planes and decoders over steps, in memory of its own that recorded steps read and write.

    Args:
        field: whose parameters are averaged, from `start` on.
    """

    def __init__(self, field: RefinedField):
        self._values = dict(field.named_parameters())
        self._means = field.snapshot()
        device = field.planes.device
        self.started = False
        self._on, self._count = torch.zeros((), device=device), torch.zeros((), device=device)

    def start(self) -> None:
        """Average from the next `update` on."""
        self.started = True
        self._on.fill_(1)

    @torch.no_grad()
    def update(self) -> None:
        """Take in the parameters as they are now."""
        self._count += self._on
        share = self._on / self._count.clamp_min(1)
        for name, value in self._values.items():
            self._means[name].lerp_(value, share)

    def snapshot(self) -> dict[str, Tensor]:
        """Return the means, for `RefinedField.restore`."""
        return self._means

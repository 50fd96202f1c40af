"""Statistics of a training's stability, in memory that does not grow with its steps."""

import math
from typing import Any

_BINS = 32
"""Bins per factor of two: norms of one bin differ by 2 % at most."""


class Stability:
    """Counts steps without a usable gradient and jumps of the loss, and knows the gradient norms' distribution.

    `upset` is how many steps in a row, up to the last, went wrong: no usable gradient or loss, or a jump of the loss.

    Args:
        spike: a loss this many times the running mean is one.
        memory: steps over which that mean forgets; as many pass before any spike is counted.
    """

    def __init__(self, spike: float, memory: int):
        self.spike, self.memory = spike, memory
        self.nonfinite = self.spikes = self.steps = self.upset = 0
        self._mean = math.nan
        self._norms: dict[int, int] = {}

    def add(self, norm: float, loss: float) -> None:
        """Add one optimizer step's gradient norm, before clipping, and its loss."""
        far = self.steps > 0 and 0 < self.spike * self._mean < loss
        self.upset = 0 if math.isfinite(norm) and math.isfinite(loss) and not far else self.upset + 1
        if not math.isfinite(norm):
            self.nonfinite += 1
        elif norm > 0:
            number = math.floor(_BINS * math.log2(norm))
            self._norms[number] = self._norms.get(number, 0) + 1
        if not math.isfinite(loss):
            return
        self.spikes += far and self.steps >= self.memory
        # a spike moves the mean little, so that the next is still seen as one
        loss = self.spike * self._mean if far else loss
        self.steps += 1
        share = 1 / min(self.steps, self.memory)
        self._mean = loss if self.steps == 1 else (1 - share) * self._mean + share * loss

    def quantile(self, share: float) -> float | None:
        """Return the norm that this share of the positive, finite ones does not exceed, to 1 %; None without any."""
        left = share * sum(self._norms.values())
        for number in sorted(self._norms):
            left -= self._norms[number]
            if left <= 0:
                return 2 ** ((number + 0.5) / _BINS)
        return None

    def summary(self) -> dict[str, float | int | None]:
        """Return the numbers under the names of `ResultRow`."""
        return {
            "nonfinite_grad_steps": self.nonfinite,
            "loss_spikes": self.spikes,
            "grad_norm_p99": self.quantile(0.99),
        }

    def state_dict(self) -> dict[str, Any]:
        counts = {"nonfinite": self.nonfinite, "spikes": self.spikes, "steps": self.steps, "upset": self.upset}
        return counts | {"mean": self._mean, "norms": dict(self._norms)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.nonfinite, self.spikes, self.steps = state["nonfinite"], state["spikes"], state["steps"]
        self._mean, self._norms = state["mean"], dict(state["norms"])
        self.upset = state.get("upset", 0)  # not in runs that were begun before it was recorded

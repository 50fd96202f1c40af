"""Averages of the weights whose length is chosen after training (Karras et al. 2024, EDM2, arXiv 2312.02696, sec. 3).

Two averages with power-function profiles are kept while training runs, and saved from time to time. Any average of the
family, up to any saved step, is then a weighted sum of the snapshots (their eq. 135 and algorithm 3).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from nerfdiff.utils.errors import CheckpointError, ConfigError
from nerfdiff.utils.files import atomic


class PowerAverages:
    """Averages of weights with power-function profiles, one per length, while training runs.

    Args:
        lengths: relative standard deviations σ_rel, shares of the training so far.
        values: averages so far, per length in the order of the parameters; None begins with the first update.

    Raises:
        ConfigError: a length that no average has.
    """

    def __init__(self, lengths: Sequence[float], values: dict[str, list[Tensor]] | None = None):
        self.exponents = {str(length): exponent_of(length) for length in lengths}
        self.values = values or {}

    @torch.no_grad()
    def update(self, parameters: Sequence[Tensor], step: int) -> None:
        """Average the weights after optimizer step number `step`, counted from 1.

        Eq. 127: θ̂_t = β_t θ̂_{t-1} + (1 - β_t) θ_t with β_t = (1 - 1/t)^(γ+1).
        """
        current = [parameter.detach() for parameter in parameters]
        for length, exponent in self.exponents.items():
            if length not in self.values:
                self.values[length] = [value.clone() for value in current]
            torch._foreach_lerp_(self.values[length], current, 1 - (1 - 1 / step) ** (exponent + 1))

    def save(self, folder: Path, names: Sequence[str], step: int) -> None:
        """Write `step_<n>_<length>.safetensors` (fp16), which `average_of` reads."""
        for length, values in self.values.items():
            state = {n: v.to("cpu", torch.float16).contiguous() for n, v in zip(names, values, strict=True)}
            with atomic(folder / f"step_{step:07d}_{length}.safetensors") as temporary:
                save_file(state, temporary, {"step": str(step), "length": length})


def exponent_of(length: float) -> float:
    """γ of the average whose profile t^γ has the relative standard deviation `length` (eq. 123 to 126: the root of
    γ³ + 7γ² + (16 − σ_rel⁻²)γ + (12 − σ_rel⁻²)).

    Raises:
        ConfigError: `length` is not above 0 and at most 0.28, where γ reaches 0.
    """
    if not 0 < length <= 0.288:
        raise ConfigError(f"an average's length {length} must be above 0 and at most 0.288 of the training")
    inverse = length**-2
    return float(max(np.roots([1, 7, 16 - inverse, 12 - inverse]).real))


def products(
    steps: Float[np.ndarray, "rows"],
    exponents: Float[np.ndarray, "rows"],
    other_steps: Float[np.ndarray, "columns"],
    other_exponents: Float[np.ndarray, "columns"],
) -> Float[np.ndarray, "rows columns"]:
    """Inner products of normalised profiles (γ + 1) τ^γ / t^(γ+1) on [0, t]: of each row's with each column's."""
    (t, g), (u, h) = (x[:, None] for x in (steps, exponents)), (x[None] for x in (other_steps, other_exponents))
    shorter = np.minimum(t, u)
    return (
        (g + 1)
        * (h + 1)
        * np.exp((g + h + 1) * np.log(shorter) - (g + 1) * np.log(t) - (h + 1) * np.log(u))
        / (g + h + 1)
    )


def combination(
    steps: Sequence[int], lengths: Sequence[float], step: int, length: float
) -> Float[np.ndarray, "snapshots"]:
    """By how much to weigh snapshots so that their sum is closest to the average of `length` at `step` (algorithm 3),
    under the condition that the weights add up to 1, as few snapshots do not give by themselves."""
    t, g = np.asarray(steps, float), np.array([exponent_of(value) for value in lengths])
    wanted_t, wanted_g = np.array([float(step)]), np.array([exponent_of(length)])
    count = len(t)
    system = np.block([[products(t, g, t, g), np.ones((count, 1))], [np.ones((1, count)), np.zeros((1, 1))]])
    aim = np.append(products(t, g, wanted_t, wanted_g)[:, 0], 1.0)
    # the profiles are nearly dependent: least squares in float64
    return np.linalg.lstsq(system, aim, rcond=1e-12)[0][:count]


def average_of(folder: str | Path, length: float, step: int | None = None) -> Mapping[str, Tensor]:
    """The average of `length`, up to `step` (None: the last), from a run's snapshots; fp32.

    Raises:
        CheckpointError: there are no snapshots, none up to that step, or one is damaged.
        ConfigError: no average has that length.
    """
    found = []
    for path in sorted(Path(folder).glob("step_*.safetensors")):
        try:
            with safe_open(path, "pt") as file:
                about = file.metadata()
            found.append((int(about["step"]), float(about["length"]), path))
        except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"{path} is not a readable snapshot ({error!r}); delete it to go without it"
            ) from error
    steps = sorted({known for known, _, _ in found})
    if not found or (step is not None and step not in steps):
        raise CheckpointError(f"{folder} has no snapshots{f' of step {step}' if found else ''}; it has steps {steps}")
    step = steps[-1] if step is None else step
    found = [one for one in found if one[0] <= step]
    weights = combination([one[0] for one in found], [one[1] for one in found], step, length)
    state: dict[str, Tensor] = {}
    for weight, (_, _, path) in zip(weights, found, strict=True):
        with safe_open(path, "pt") as file:
            for name in file.keys():  # noqa: SIM118 (no dictionary)
                value = float(weight) * file.get_tensor(name).float()
                state[name] = value if name not in state else state[name] + value
    return state

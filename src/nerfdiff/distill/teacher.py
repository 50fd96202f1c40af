"""Teachers: the target images that the field is fitted to at each step. Methods differ in nothing else."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from nerfdiff.distill.virtual_views import Images, VirtualViews
from nerfdiff.utils.errors import ConfigError


@runtime_checkable
class Teacher(Protocol):
    """Give target images of all virtual views, step by step."""

    steps: int
    """Length of the schedule: the number of times targets are asked for, where time is not short."""

    follows_field: bool
    """True if targets depend on the field's renderings, which are made for that only."""

    t: float | None
    """Time of the last step, where all views share one."""

    weight: float | None
    """Weight of guidance at the last step, where there is one."""

    view_weights: Float[Tensor, "views"] | None
    """Weights of the views' losses at the last step; None weighs all the same."""

    gap: Float[Tensor, ""] | None
    """Mean squared error of the renderings against the denoised images at the last step; None where they were not
    compared."""

    def targets(self, step: float | int, rendered: Images | None) -> Images | None:
        """Return images in [0, 1] to fit the field to; None where it stays as it is, its renderings being the targets.

        Args:
            step: place on the schedule, from 0 to less than `steps`, growing. A step is 1 long, or as the virtual views
                say (`VirtualViews.until`).
            rendered: the field's images of the chosen views now, in [0, 1], and zeros for the others
                (`VirtualViews.chosen`); None where the teacher does not follow the field.
        """


MakeTeacher = Callable[[VirtualViews], Teacher]


def uses_current_rendering(condition: str) -> bool:
    """Return true for `current`: the CDM is conditioned on the field's current rendering, else on the `first`.

    Raises:
        ConfigError: neither of them.
    """
    if condition not in ("first", "current"):
        raise ConfigError(f"teacher.condition={condition!r}: choose first or current")
    return condition == "current"

"""What a test-time method is: one input image and a trained model to images of other views."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.model import NerfDiff


@dataclass(frozen=True)
class Views:
    """Predicted images of one scene's target views, and what they cost to make.

    Args:
        images: colours in [0, 1].
        opacity: of the field, where the method has one.
        depth: distance along z in scene units, where the method has a field.
        denoiser_calls: images passed through the CDM.
        field_queries: points at which a field was evaluated.
    """

    images: Float[Tensor, "views 3 height width"]
    opacity: Float[Tensor, "views height width"] | None = None
    depth: Float[Tensor, "views height width"] | None = None
    denoiser_calls: int = 0
    field_queries: int = 0


@runtime_checkable
class Strategy(Protocol):
    """A test-time method. `name` is what results call it."""

    name: str

    def predict(self, model: NerfDiff | None, scene: ViewBatch, seed: int) -> Views:
        """Images of every target view of `scene`, a batch of one scene, from its source view alone.

        Baselines that use no model take None.
        """

"""What a test-time method is: one input image and a trained model to images of other views."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from lightning import Callback
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.field_file import SavedField
from nerfdiff.distill.trace import Step
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
        field: what the images are renderings of, where the method has a field.
        trace: of its fitting, where it was fitted.
        status: `ok`, or why the field is not the one that the method ended with.
    """

    images: Float[Tensor, "views 3 height width"]
    opacity: Float[Tensor, "views height width"] | None = None
    depth: Float[Tensor, "views height width"] | None = None
    denoiser_calls: int = 0
    field_queries: int = 0
    field: SavedField | None = None
    trace: Sequence[Step] = ()
    status: str = "ok"


@runtime_checkable
class Strategy(Protocol):
    """A test-time method. `name` is what results call it."""

    name: str

    def predict(self, model: NerfDiff | None, scene: ViewBatch, seed: int, callbacks: Sequence[Callback] = ()) -> Views:
        """Images of every target view of `scene`, a batch of one scene, from its source view alone.

        Args:
            model: frozen; baselines that use none take None.
            callbacks: of the Lightning Trainer that fits a field, where the method has one.
        """

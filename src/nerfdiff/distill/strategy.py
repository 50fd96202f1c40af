"""Test-time methods: from one input image and a trained model to images of other views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from lightning import Callback
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.trace import Step
from nerfdiff.fit.saved_field import SavedField
from nerfdiff.metrics.depth import z_depth
from nerfdiff.model import NerfDiff
from nerfdiff.render.renderer import RenderedViews, Renderer
from nerfdiff.utils.timing import timed


@dataclass(frozen=True)
class PredictedViews:
    """Predicted images of one scene's target views, and their cost.

    Args:
        images: colours in [0, 1].
        opacity: of the field, where the method has one.
        depth: distance along z in scene units, where the method has a field.
        denoiser_calls: images passed through the CDM.
        field_queries: points at which a field was evaluated.
        virtual_views: K, how many views a field was fitted to, where it was.
        steps, steps_planned: of the teacher, that were taken, and that the budget has.
        stopped_by: why they ended: `schedule`, all were taken; or `agreement` or `deadline`, something was left out.
        field: the field that the images are rendered from, where the method has one.
        trace: of its fitting, where it was fitted.
        status: `ok`, or why the field is not the one that the method ended with.
    """

    images: Float[Tensor, "views 3 height width"]
    opacity: Float[Tensor, "views height width"] | None = None
    depth: Float[Tensor, "views height width"] | None = None
    denoiser_calls: int = 0
    field_queries: int = 0
    virtual_views: int | None = None
    steps: int | None = None
    steps_planned: int | None = None
    stopped_by: str | None = None
    field: SavedField | None = None
    trace: Sequence[Step] = ()
    status: str = "ok"

    @staticmethod
    @timed("render")
    @torch.no_grad()
    def of_field(
        saved: SavedField,
        cameras: Cameras,
        denoiser_calls: int = 0,
        field_queries: int = 0,
        trace: Sequence[Step] = (),
        status: str = "ok",
    ) -> "PredictedViews":
        """Render a field from cameras [1, views].

        Args:
            denoiser_calls, field_queries: spent on the field before; rendering is added here.
        """
        rendering = saved.field.render(saved.renderer, cameras)
        views = PredictedViews.of_rendering(rendering, saved.renderer, cameras)
        return replace(
            views,
            denoiser_calls=denoiser_calls,
            field_queries=field_queries + views.field_queries,
            field=saved,
            trace=trace,
            status=status,
        )

    @staticmethod
    def of_rendering(rendering: RenderedViews, renderer: Renderer, cameras: Cameras) -> "PredictedViews":
        """Take the images, opacity and z-depth of a rendering of cameras [1, views]; no field is kept."""
        return PredictedViews(
            images=rendering.images[0],
            opacity=rendering.opacity[0],
            depth=z_depth(rendering.depth[0], cameras[0]),
            field_queries=renderer.samples_per_ray * rendering.opacity.numel(),
        )


@runtime_checkable
class Strategy(Protocol):
    """A test-time method. `name` is what results call it."""

    name: str

    def predict(
        self, model: NerfDiff | None, scenes: Sequence[ViewBatch], seed: int, callbacks: Sequence[Callback] = ()
    ) -> list[PredictedViews]:
        """Predict every target view of each scene from its source view alone, independently of the other scenes.

        Args:
            model: frozen; baselines that use none take None.
            scenes: batches of one.
            callbacks: of the Lightning Trainer that fits fields, where the method has one.
        """

"""The inner steps of distillation: a field fitted to images on random rays (Algorithm 1's last lines)."""

import logging
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.fit.objective import FitLoss
from nerfdiff.fit.ray_batches import RayBatches
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.weight_average import WeightAverage
from nerfdiff.render.renderer import Renderer
from nerfdiff.utils.errors import ConfigError, OutOfMemory, size_text
from nerfdiff.utils.memory import free_memory

log = logging.getLogger(__name__)

WARM_UP = 3
"""Steps before one is recorded: the first ones choose kernels and make Adam's state."""


class InnerSteps:
    """Take optimizer steps on random rays of all views of each scene.

    All random numbers are drawn before the first step, and nothing in between waits for the device: on a GPU a step
    is recorded once as a CUDA graph and replayed, since launching its kernels takes longer than they do.

    Args:
        field: of one or several scenes; each fits its own part of it, independently of the others.
        renderer: of the field.
        batches: rays and colours; and, where they are kept, the coarse weights that importance samples are drawn from
            instead of new ones.
        optimizer: of the field's parameters; `capturable` where steps are to be recorded.
        rays: B, per step and scene.
        generators: one per scene, so that a scene's rays do not depend on the other scenes.
        record: replay a CUDA graph, on a GPU.
        loss: of the rays, the paper's where it is not given; where it has patches, rays are drawn in them.
        average: of the field's parameters, which every step adds to.

    Raises:
        ConfigError: patches larger than the images, or rays that are no whole number of them.
    """

    recording = True
    """False once recording failed in this process: it is not tried again for every scene."""

    def __init__(
        self,
        field: RefinedField,
        renderer: Renderer,
        batches: RayBatches,
        optimizer: torch.optim.Optimizer,
        rays: int,
        generators: Sequence[torch.Generator],
        record: bool,
        loss: FitLoss | None = None,
        average: WeightAverage | None = None,
    ):
        self.field, self.renderer, self.batches, self.optimizer = field, renderer, batches, optimizer
        self.rays, self.generators = rays, generators
        self.loss, self.average = loss or FitLoss(), average
        self._side = self.loss.objective.patch
        self._patches = self.loss.objective.patches_of(rays)
        if self._side > batches.largest_patch:
            raise ConfigError(
                f"strategy.patch={self._side}: images of {batches.largest_patch} pixels have no patch of that size"
            )
        self._record = record and InnerSteps.recording and field.planes.device.type == "cuda"
        self._graph: torch.cuda.CUDAGraph | None = None
        self._steps: int | None = None

    @property
    def queries(self) -> int:
        """Number of points of one scene at which a step evaluates its field."""
        return self.rays * self.renderer.samples_per_ray + self.loss.queries(self.rays, self.renderer)

    @property
    def recorded(self) -> bool:
        """True if steps are replayed from a CUDA graph."""
        return self._graph is not None

    def run(self, steps: int) -> Float[Tensor, "{steps} scenes"]:
        """Take `steps` steps; return the mean squared error of each, before it, whatever the loss."""
        self._draw(steps)
        taken = 0
        if self._record and self._graph is None and steps > WARM_UP:
            taken = self._warm_up()
            self._try_to_record()
        for _ in range(taken, steps):
            self._step() if self._graph is None else self._graph.replay()
        return self._losses.clone()

    def _draw(self, steps: int) -> None:
        """Draw rays and samples on them into the same memory every time, which a recorded step reads."""
        scenes = len(self.field)
        device = self.field.planes.device
        if steps != self._steps:
            self._require_memory(steps * scenes * self.rays * (16 + 4 * self.renderer.samples_per_ray), device)
            self._steps, self._graph = steps, None
            self._drawn = torch.empty(scenes, steps, self._patches, dtype=torch.long, device=device)
            self._picked = torch.empty(scenes, steps, self.rays, dtype=torch.long, device=device)
            self._jitter = torch.empty(scenes, steps, self.rays, self.renderer.samples_per_ray, device=device)
            self._losses = torch.empty(steps, scenes, device=device)
            self._number = torch.zeros(1, dtype=torch.long, device=device)
        self._picked.copy_(self.batches.draw(self._side, self._drawn, self.generators))
        for jitter, source in zip(self._jitter, self.generators, strict=True):
            jitter.uniform_(generator=source)
        self._number.zero_()

    def _require_memory(self, needed: int, device: torch.device) -> None:
        """Raise OutOfMemory before the system kills the process for memory that is not there."""
        free = free_memory(device)
        if needed > free:
            raise OutOfMemory(
                f"{self.rays} rays a step take {size_text(needed)} for the numbers that are drawn alone, and "
                f"{device.type} has {size_text(free)} free: lower budget.rays, budget.inner_steps or scenes_at_once"
            )

    def _step(self) -> None:
        """Take the step whose number is on the device."""
        picked, jitter = (drawn.index_select(1, self._number)[:, 0] for drawn in (self._picked, self._jitter))
        rays, colours = self.batches.at(picked)
        field = self.field.field()
        rgb = self.renderer.render(field, rays, jitter, self.batches.coarse_at(picked)).rgb
        losses, errors = self.loss(rgb, colours, self.batches.weights_at(picked))
        losses = self.loss.regularise(losses, field, self.renderer, rays, jitter)
        self.optimizer.zero_grad()
        losses.sum().backward()  # each scene's gradient is that of its own loss
        self.optimizer.step()
        if self.average is not None:
            self.average.update()
        self._losses.index_copy_(0, self._number, errors[None])
        self._number += 1

    def _warm_up(self) -> int:
        """Take the first steps on a stream of their own, as CUDA graphs need; return how many."""
        here, aside = torch.cuda.current_stream(), torch.cuda.Stream()
        aside.wait_stream(here)
        with torch.cuda.stream(aside):
            for _ in range(WARM_UP):
                self._step()
        here.wait_stream(aside)
        return WARM_UP

    def _try_to_record(self) -> None:
        graph = torch.cuda.CUDAGraph()
        try:
            self.optimizer.zero_grad()
            # the inner context would not give the stream back where the end of recording fails
            # other threads may go on allocating, as those that pin a loader's batches do
            with (
                torch.cuda.stream(torch.cuda.current_stream()),
                torch.cuda.graph(graph, capture_error_mode="thread_local"),
            ):
                self._step()
        except RuntimeError as error:
            lines = str(error).splitlines()
            log.warning("inner steps are not replayed from a CUDA graph: %s", lines[0] if lines else "no message")
            self._record = False
            # memory that ran out says nothing of the next scene; the end of recording may raise something of its own
            if not any(isinstance(e, torch.OutOfMemoryError) for e in (error, error.__context__)):
                InnerSteps.recording = False
            return
        self._graph = graph

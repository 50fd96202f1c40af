"""A CUDA device without a GPU: fake tensors that know shapes, types and devices, and kernels that do nothing.

What computes on the host computes; what computes on the device is checked as PyTorch's own fake kernels check it.
"""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from unittest import mock

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.utils._pytree import tree_flatten, tree_unflatten

DEVICE = torch.device("cuda", 0)


class FakeCuda(FakeTensorMode):
    """Fakes what is on a GPU alone.

    `copies` are the operations that brought something from the host to the GPU, `read` the number that is found where
    one is read back: none, which is an error; `rendering` and `norm` stand for the kernels.
    """

    def __init__(self):
        super().__init__(allow_non_fake_inputs=True)
        self.copies: list[str] = []
        self.read: float | None = None
        self.rendering, self.norm = Nothing(), Nothing()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        values, spec = tree_flatten((args, kwargs or {}))
        values = [None if isinstance(value, Stream) and value.device == DEVICE else value for value in values]
        args, kwargs = tree_unflatten(values, spec)
        tensors = [value for value in values if isinstance(value, Tensor)]
        faked = any(isinstance(value, FakeTensor) for value in tensors)
        device = kwargs.get("device")
        if not faked and (device is None or torch.device(device).type == "cpu"):
            return func(*args, **kwargs | ({"pin_memory": None} if "pin_memory" in kwargs else {}))
        if func is torch.ops.aten._local_scalar_dense.default and self.read is not None:
            return self.read
        if func.overloadpacket.__name__.startswith("_fused_adam"):  # there are no fakes of these
            assert {tensor.device for tensor in tensors} == {DEVICE}
            return None
        out = super().__torch_dispatch__(func, types, args, kwargs)
        copied = func.overloadpacket.__name__ in ("_to_copy", "copy_", "_copy_from")
        if copied and out.is_cuda and not all(tensor.is_cuda for tensor in tensors):
            self.copies.append(str(func))
        return out


class Stream(torch.Generator):
    """A generator that says it is where it was asked to be."""

    def __new__(cls, device="cpu"):
        made = super().__new__(cls)
        made.where = torch.device(device)
        return made

    @property
    def device(self) -> torch.device:
        return DEVICE if self.where.type == "cuda" else self.where


class Nothing:
    """A kernel, with the number of its calls."""

    def __init__(self):
        self.calls = 0

    def __getitem__(self, grid):
        return self

    def __call__(self, *args, **kwargs):
        self.calls += 1


@contextmanager
def fake_cuda() -> Iterator[FakeCuda]:
    """The mode, with kernels as on a GPU of compute capability 9.0."""
    from nerfdiff.diffusion import norm_silu
    from nerfdiff.diffusion.kernels import function as norms
    from nerfdiff.fit import inner_steps
    from nerfdiff.render import backend
    from nerfdiff.render.kernels import passes

    properties = SimpleNamespace(multi_processor_count=132)
    on_gpu = {
        "get_device_capability": lambda *_: (9, 0),
        "get_device_properties": lambda *_: properties,
        "device_of": lambda *_: nullcontext(),
        "is_bf16_supported": lambda *_: True,
        "is_current_stream_capturing": lambda: False,
    }
    looks = ("_look", "_gradient", "draw_kernel", "composite_kernel", "composite_gradient_kernel")
    mode = FakeCuda()
    norm_kernels = [name for name in dir(norms) if name.endswith("_kernel")]
    with (
        mock.patch.multiple(torch.cuda, **on_gpu),
        mock.patch.object(torch.cuda.amp.common, "amp_definitely_not_available", return_value=False),
        mock.patch.object(torch, "Generator", Stream),
        mock.patch.object(Tensor, "backward", backward),
        mock.patch.object(nn.Module, "_apply", _apply),
        # fake convolutions without cuDNN do not keep channels_last, which the kernels ask for and would make
        mock.patch.object(norm_silu, "_fusible", lambda x: x.is_cuda),
        mock.patch.multiple(norm_silu, _warned=set(), _give_up=_raise),
        mock.patch.multiple(backend, _warned=set(), _failures={}, _COMPARED=(), _note_failure=_raise),
        mock.patch.object(inner_steps, "free_memory", return_value=2**40),
        mock.patch.multiple(passes, **dict.fromkeys(looks, mode.rendering)),
        mock.patch.multiple(norms, **dict.fromkeys(norm_kernels, mode.norm)),
        mode,
    ):
        yield mode


def _apply(module: nn.Module, function, recurse: bool = True) -> nn.Module:
    """`Module.to` and the like with new parameters: fake ones cannot be changed in place."""
    for child in module.children():
        child._apply(function)
    for values in (module._parameters, module._buffers):
        for name, value in values.items():
            if value is not None:
                with torch.no_grad():
                    new = function(value)
                values[name] = nn.Parameter(new, value.requires_grad) if isinstance(value, nn.Parameter) else new
    return module


def _raise(*args) -> None:
    """Nothing falls back where kernels fail."""
    raise next(one for one in args if isinstance(one, Exception))


def backward(loss: Tensor) -> None:
    """`Tensor.backward` node by node: autograd's engine wants the driver.

    Raises:
        AssertionError: a gradient on another device than what it is of.
        RuntimeError: one of another shape.
    """
    root = loss.grad_fn
    waiting, todo = {root: 0}, [root]  # the nodes from which gradients are still to come
    while todo:
        for following, _ in todo.pop().next_functions:
            if following is not None:
                if following not in waiting:
                    todo.append(following)
                waiting[following] = waiting.get(following, 0) + 1
    given = {node: {} for node in waiting}
    given[root][0] = torch.ones_like(loss)
    ready = [root]
    while ready:
        node = ready.pop()
        gradients = [_as_engine(given[node].get(i), expected) for i, expected in enumerate(node._input_metadata)]
        if hasattr(node, "variable"):
            (gradient,), before = gradients, node.variable.grad
            if gradient is not None:
                node.variable.grad = gradient.detach() if before is None else before + gradient.detach()
            continue
        with torch.no_grad():
            found = _of_inputs(node, gradients)
        for gradient, (target, number) in zip(found, node.next_functions, strict=True):
            if target is None:
                continue
            if gradient is not None:
                before = given[target].get(number)
                given[target][number] = gradient if before is None else before + gradient
            waiting[target] -= 1
            if waiting[target] == 0:
                ready.append(target)


def _as_engine(gradient: Tensor | None, expected) -> Tensor | None:
    """What the engine makes of a gradient before it hands it on."""
    if gradient is None:
        return None
    assert gradient.device == expected.device, (gradient.device, expected.device)
    return gradient.sum_to_size(expected.shape).to(expected.dtype)


def _of_inputs(node, gradients: list[Tensor | None]) -> list[Tensor | None]:
    """One for each of the functions that follow."""
    if all(gradient is None for gradient in gradients):
        return [None] * len(node.next_functions)
    if not hasattr(node, "needs_input_grad"):
        found = node(*gradients)
        return list(found) if isinstance(found, tuple) else [found]
    # written in Python: given zeros for nothing, and giving something for each argument, tensor or not
    zeros = [torch.zeros(m.shape, dtype=m.dtype, device=m.device) for m in node._input_metadata]
    found = node.apply(
        *(zero if gradient is None else gradient for gradient, zero in zip(gradients, zeros, strict=True))
    )
    needed = iter([one for one, needs in zip(found, node.needs_input_grad, strict=True) if needs])
    return [None if target is None else next(needed) for target, _ in node.next_functions]

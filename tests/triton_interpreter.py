"""Triton's interpreter, in which kernels are tested where there is no GPU."""

import os
from importlib.util import find_spec


def interpret_kernels() -> None:
    """Choose it, which has to be done before Triton is imported.

    Before 3.8 (PyTorch 2.11 has 3.6) it counts loops by `int` of arrays of one element, which NumPy refuses since 2.4.
    """
    os.environ.setdefault("TRITON_INTERPRET", "1")
    if find_spec("triton") is None:
        return
    import triton
    from triton.runtime import interpreter

    if tuple(map(int, triton.__version__.split(".")[:2])) >= (3, 8):
        return
    patch = interpreter._patch_lang_tensor

    def patched(tensor, scope):
        patch(tensor, scope)
        scope.set_attr(tensor, "__index__", lambda self: self.handle.data.item())

    interpreter._patch_lang_tensor = patched

"""Shapes and types of annotated functions are checked while tests run (and only then: the hook breaks compilation)."""

import torch
from jaxtyping import install_import_hook

from triton_interpreter import interpret_kernels

if not torch.cuda.is_available():
    interpret_kernels()

install_import_hook("nerfdiff", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

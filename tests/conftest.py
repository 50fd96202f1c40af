"""Shapes and types of annotated functions are checked while tests run (and only then: the hook breaks compilation)."""

import os

import torch
from jaxtyping import install_import_hook

if not torch.cuda.is_available():
    # kernels run in Triton's interpreter then, which is chosen when triton is imported
    os.environ.setdefault("TRITON_INTERPRET", "1")

install_import_hook("nerfdiff", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

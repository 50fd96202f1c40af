"""Shapes and types of annotated functions are checked while tests run (and only then: the hook breaks compilation).

Each process takes one thread, those that tests start included: `make test` has a process for every core, and threads
only wait for each other on tensors as small as these.
"""

import os
import signal

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as for what a script starts in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)
os.environ["OMP_NUM_THREADS"] = "1"  # before torch is imported
os.environ["NERFDIFF_TRUSTED_KERNELS"] = ""  # what one test's kernels pass is not known to another's

import torch
from jaxtyping import install_import_hook

from triton_interpreter import interpret_kernels

torch.set_num_threads(1)
if not torch.cuda.is_available():
    interpret_kernels()

install_import_hook(["nerfdiff", "procedural"], "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

"""Device code of the U-Nets, in Triton. Files with `@triton.jit` hold nothing else: see nerfdiff.render.kernels."""

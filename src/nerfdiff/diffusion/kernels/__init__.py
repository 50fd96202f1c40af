"""GroupNorm, scale, shift and SiLU of the U-Nets in Triton; `function.fused_norm` is the way in.

Files with `@triton.jit` hold nothing else: see nerfdiff.render.kernels.
"""

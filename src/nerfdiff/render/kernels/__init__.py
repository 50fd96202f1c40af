"""The fused renderer: gather, decoder and compositing of a triplane field in Triton.

`function.fused_render` is the way in. Files with `@triton.jit` hold device code only: an import hook that checks types
would wrap what Triton has to read as source, and `no_type_check` is what such hooks honour.
"""

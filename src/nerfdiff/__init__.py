"""NerfDiff: single-image view synthesis with NeRF-guided distillation from 3D-aware diffusion."""

__version__ = "0.1.0"

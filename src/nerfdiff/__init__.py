"""NerfDiff: single-image view synthesis with NeRF-guided distillation from 3D-aware diffusion."""

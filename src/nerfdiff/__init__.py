"""NerfDiff: single-image view synthesis with NeRF-guided distillation from 3D-aware diffusion.

`load`, `load_scene`, `Model` and `Scene` are those of `nerfdiff.api`, which is imported when they are first used.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nerfdiff.api import Model, Scene, load, load_scene

__version__ = "0.1.0"
__all__ = ["Model", "Scene", "__version__", "load", "load_scene"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from nerfdiff import api  # slow to import: not for commands

        return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

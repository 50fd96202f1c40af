"""The kind of scene that a configuration asks for."""

from collections.abc import Mapping
from typing import Any

from nerfdiff.utils.errors import ConfigError
from procedural.kinds.abo import ABOScenes
from procedural.kinds.clevr3d import Clevr3DScenes
from procedural.kinds.kind import SceneKind
from procedural.kinds.srn import SRNScenes

KINDS = {"cars": SRNScenes, "chairs": SRNScenes, "abo": ABOScenes, "clevr3d": Clevr3DScenes}


def scene_kind(cfg: Mapping[str, Any]) -> SceneKind:
    """Read `cfg["scenes"]` and what goes with it.

    Raises:
        ConfigError: the category is unknown, or a value is not possible.
    """
    category = cfg["scenes"]["category"]
    if category not in KINDS:
        raise ConfigError(f"scenes.category={category}: expected one of {', '.join(KINDS)}")
    return KINDS[category].from_config(cfg)

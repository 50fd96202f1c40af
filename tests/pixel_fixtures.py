"""Small pixel-aligned NeRFs for tests."""

import copy

from model_fixtures import CONFIG

ENCODERS = {
    "pixelnerf": {"channels": [8, 8, 16], "blocks": [1, 2], "stride": 2, "pool": True, "groups": 4},
    "visionnerf": {
        "transformer": {"patch": 4, "grid": 4, "width": 16, "heads": 2, "mlp": 32, "taps": [0, 1, 2, 3]},
        "reassembled": [4, 6, 8, 10],
        "features": 16,
        "stem": 8,
        "stride": 1,
        "groups": 4,
    },
}
MLP = {"hidden": 16, "blocks": 3, "injections": 2, "frequencies": 3, "first_frequency": 1.5}


def pixel_config(name: str) -> dict:
    """Arguments of `NerfDiff` with such a field."""
    config = copy.deepcopy(CONFIG)
    config["field"] = {
        "name": name,
        "density_shift": -1.0,
        "density_scale": 16.0,
        "encoder": copy.deepcopy(ENCODERS[name]),
        "mlp": dict(MLP),
    }
    config["conditioning"]["cross_attention"] = False
    return config

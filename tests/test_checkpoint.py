"""Models are loaded with the renderer that a run asks for; what is saved stays as it was trained."""

import pytest

from nerfdiff.checkpoint import load_model
from nerfdiff.utils.errors import ConfigError

SETTINGS = ({}, {"backend": "torch", "kernel_precision": "tf32"}, {"uniform_samples": 3, "chunk": 2048})


@pytest.mark.parametrize("settings", SETTINGS)
def test_a_model_is_built_with_the_renderer_settings_of_the_run(settings):
    plain, loaded = load_model("demo", "ema"), load_model("demo", "ema", renderer=settings)
    assert vars(loaded.model.renderer) == vars(plain.model.renderer) | settings
    assert loaded.config == plain.config
    assert not {"backend", "kernel_precision"} & loaded.config["render"].keys()


@pytest.mark.parametrize("settings", [{"backend": "cuda"}, {"kernel_precision": "fp8"}])
def test_settings_that_a_renderer_cannot_have_are_no_fault_of_the_checkpoint(settings):
    ((name, value),) = settings.items()
    with pytest.raises(ConfigError, match=f"{name}='{value}': choose auto"):
        load_model("demo", "ema", renderer=settings)

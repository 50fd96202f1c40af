"""Settings are flat in `conf/` and whole in the code."""

from dataclasses import dataclass, fields, replace

import pytest
from hydra.utils import instantiate

from nerfdiff.cli import load_config
from nerfdiff.diffusion.sampler import SamplerSettings
from nerfdiff.fit.settings import FitSettings
from nerfdiff.utils.config import from_keys, plain


@dataclass(frozen=True)
class Size:
    height: int
    width: int = 4


@from_keys(size=Size)
@dataclass(frozen=True)
class Frame:
    name: str
    size: Size


def test_a_class_is_built_from_keys_or_from_whole_settings():
    whole = Frame("a", Size(2, 3))
    assert Frame(name="a", height=2, width=3) == Frame(name="a", size=Size(2, 3)) == whole
    assert Frame("a", height=2).size == Size(2, 4)
    assert replace(whole, name="b") == Frame("b", Size(2, 3))


@pytest.mark.parametrize("keys", [{}, {"height": 1, "depth": 2}, {"width": 1}])
def test_keys_that_are_missing_or_unknown_are_refused(keys):
    with pytest.raises(TypeError):
        Frame("a", **keys)


@pytest.mark.parametrize("strategy", ["ngd", "ngd_current", "direct", "sds", "stochastic"])
def test_every_fit_setting_is_a_key_of_a_strategy(strategy):
    words = ["ckpt=none", f"strategy={strategy}", "strategy.lr_planes=0.125", "prior=sphere"]
    keys = plain(load_config("distill", words).strategy)
    fit = instantiate(keys).fit
    assert fit.lr_planes == 0.125
    assert {field.name: getattr(fit, field.name) for field in fields(FitSettings)}.items() <= keys.items()


@pytest.mark.parametrize("strategy", ["ngd", "direct", "stochastic"])
def test_every_sampler_setting_is_a_key_of_a_teacher(strategy):
    words = ["ckpt=none", f"strategy={strategy}", "strategy.teacher.sampler=dpmpp_2m", "prior=sphere"]
    keys = plain(load_config("distill", words).strategy.teacher)
    assert keys["sampler"] == "dpmpp_2m"
    assert {field.name for field in fields(SamplerSettings)} - {"deep"} <= keys.keys()


def test_cdm_and_previews_take_the_same_sampler_settings():
    cdm = instantiate(plain(load_config("distill", ["ckpt=none", "strategy=cdm", "strategy.eta=0.5"]).strategy))
    preview = instantiate(plain(load_config("train", []).callbacks.previews.sampler))
    assert (cdm.sampling.eta, preview.sampling.eta) == (0.5, 0.0)
    assert replace(cdm.sampling, eta=0.0, deep=None) == preview.sampling

"""Kinds of single-image NeRF: the paper's triplanes, and the pixel-aligned ones beside them.

A kind is a class, which its file in conf/field names as `_target_`; its arguments are the other settings there.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import yaml
from hydra.utils import get_class
from torch import nn

from nerfdiff.field.decoder import Decoder
from nerfdiff.field.encoder import Encoder, PixelEncoder
from nerfdiff.field.field import Field, PixelField, TriplaneField
from nerfdiff.field.residual_mlp import ResidualMLP
from nerfdiff.field.resnet import ResNetPyramid
from nerfdiff.field.vision_features import VisionFeatures
from nerfdiff.inputs import CONF
from nerfdiff.utils.errors import ConfigError

TRIPLANE = "triplane"


class FieldKind(ABC):
    """A kind of single-image NeRF: its networks, and its field.

    `has_context` says whether its encoder gives the CDM features to attend to.
    """

    has_context = False

    @abstractmethod
    def networks(self, unet: Mapping[str, Any]) -> tuple[nn.Module, nn.Module]:
        """e_ψ, from images and their cameras and bounds to an `Encoding`, and f_θ.

        Args:
            unet: sizes of the CDM's U-Net, for an encoder that has the same.
        """

    @abstractmethod
    def field(self, features: Any, decoder: nn.Module) -> Field:
        """The radiance fields of a batch of scenes.

        Args:
            features: `Encoding.features`, which e_ψ made.
            decoder: f_θ.
        """


@dataclass(frozen=True)
class Triplanes(FieldKind):
    """A U-Net's planes and a shallow decoder; the arguments are those of `Decoder`."""

    channels: int
    hidden: int
    density_shift: float
    density_scale: float
    has_context = True

    def networks(self, unet):
        return Encoder(self.channels, unet), Decoder(**vars(self))

    def field(self, features, decoder):
        return TriplaneField(features, decoder)


@dataclass(frozen=True)
class PixelAligned(FieldKind):
    """An image's features where a point projects to, and a deep MLP there.

    Args:
        encoder: arguments of the backbone.
        mlp: arguments of `ResidualMLP`, as are `density_shift` and `density_scale`.
    """

    encoder: Mapping[str, Any]
    mlp: Mapping[str, Any]
    density_shift: float
    density_scale: float
    backbone = ResNetPyramid
    with_image = False

    def networks(self, unet):
        encoder = PixelEncoder(self.backbone(**self.encoder), self.with_image)
        density = {"density_shift": self.density_shift, "density_scale": self.density_scale}
        return encoder, ResidualMLP(encoder.channels, **self.mlp, **density)

    def field(self, features, decoder):
        return PixelField.of(features, decoder)


class PixelNeRF(PixelAligned):
    """A ResNet's features (Yu et al. 2021)."""


class VisionNeRF(PixelAligned):
    """A vision transformer's features and convolutions', with the pixel's colour beside them (Lin et al. 2023)."""

    backbone = VisionFeatures
    with_image = True


def field_kind(settings: Mapping[str, Any]) -> FieldKind:
    """The kind that settings describe, in a config or in a checkpoint.

    Settings come with checkpoints, which anybody may have made: nothing is called but a `FieldKind`.

    Args:
        settings: `name`, a triplane where it is not given; `_target_`, the file's in conf/field where it is not given
            (checkpoints from before have none); and the kind's arguments.

    Raises:
        ConfigError: there is no such kind, or it does not take these arguments.
    """
    settings = dict(settings)
    name, target = settings.pop("name", TRIPLANE), settings.pop("_target_", None)
    if target is None and (target := _targets().get(name)) is None:
        raise ConfigError(f"model.field.name={name!r}: choose {', '.join(_targets())}, or name a class as _target_")
    try:
        kind = get_class(target)
    except Exception as error:  # whatever a module raises that is imported
        raise ConfigError(f"model.field._target_={target} cannot be imported ({error})") from error
    if not issubclass(kind, FieldKind):
        raise ConfigError(f"model.field._target_={target} is no {FieldKind.__module__}.{FieldKind.__name__}")
    try:
        return kind(**settings)
    except TypeError as error:
        raise ConfigError(f"model.field: {target} does not take these settings ({error})") from error


def to_record(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as checkpoints hold them: without a `_target_` that the name stands for. Classes move, names stay."""
    known = settings.get("_target_") == _targets().get(settings.get("name", TRIPLANE))
    return {key: value for key, value in settings.items() if key != "_target_" or not known}


@cache
def _targets() -> dict[str, str]:
    """Classes by the names of the files in conf/field."""
    files = sorted((CONF / "field").glob("*.yaml"))
    return {path.stem: yaml.safe_load(path.read_text(encoding="utf-8"))["model"]["field"]["_target_"] for path in files}

"""Pictures to scenes: `python src/picture.py car.jpg`."""

from pathlib import Path

from omegaconf import DictConfig

from nerfdiff.cli import command_words, entry_point
from nerfdiff.inputs import check_box, check_formats, check_mask_size, check_picture_settings
from nerfdiff.utils.errors import ConfigError


def check(cfg: DictConfig) -> None:
    """Refuse settings that cannot be and files that are no pictures, before anything slow is imported.

    Raises:
        UserError: naming the setting or the file.
    """
    from nerfdiff.data.formats.images import upright_size  # with NumPy: not for --cfg

    check_formats(cfg.format)
    check_picture_settings(cfg)
    if not cfg.images:
        raise ConfigError(f"name a picture: {' '.join(command_words('picture'))} car.jpg")
    for key in ("mask", "box"):
        if cfg[key] is not None and len(cfg.images) > 1:
            raise ConfigError(
                f"{key}={cfg[key]} is of one picture, and there are {len(cfg.images)}: give one at a time"
            )
    sizes = [upright_size(Path(image)) for image in cfg.images]
    if cfg.cutout.box is not None:
        check_box(cfg.cutout.box, *sizes[0])
    if cfg.mask is not None:
        check_mask_size(cfg.mask, upright_size(Path(cfg.mask)), cfg.images[0], sizes[0])


@entry_point("picture", "ckpt", "images", "mask")
def main(cfg: DictConfig) -> None:
    """Leaves a folder for every picture."""
    check(cfg)
    from nerfdiff.pictures import pictures  # slow to import: not for --cfg

    pictures(cfg)


if __name__ == "__main__":
    main()

"""Pictures to scenes: `python src/picture.py car.jpg`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("picture", "ckpt", "images", "mask")
def main(cfg: DictConfig) -> None:
    """Leaves a folder for every picture."""
    from nerfdiff.pictures import pictures  # slow to import: not for --cfg

    pictures(cfg)


if __name__ == "__main__":
    main()

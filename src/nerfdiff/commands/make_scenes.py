"""Render procedural scenes: `python src/make_scenes.py scenes=cars`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("make_scenes")
def main(cfg: DictConfig) -> None:
    """Scenes already there are kept."""
    from procedural.generate import make_scenes

    make_scenes(cfg)


if __name__ == "__main__":
    main()

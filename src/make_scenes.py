"""Render procedural scenes: `python src/make_scenes.py scenes=cars`."""

import hydra
from omegaconf import DictConfig

from nerfdiff.scenes.generate import make_scenes


@hydra.main(version_base="1.3", config_path="../conf", config_name="make_scenes")
def main(cfg: DictConfig) -> None:
    make_scenes(cfg)


if __name__ == "__main__":
    main()

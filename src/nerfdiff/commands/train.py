"""Train NerfDiff: `python src/train.py model=large data=srn_cars data.root=/data/srn_cars`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("train", "data.root", "init")
def main(cfg: DictConfig) -> float | None:
    """Returns the held-out PSNR, which a sweep may optimise."""
    from nerfdiff.training.run import train  # slow to import: not for --cfg

    return train(cfg).get("val/psnr")


if __name__ == "__main__":
    main()

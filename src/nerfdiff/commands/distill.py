"""One picture, or every test scene, to a field: `python src/distill.py ckpt=demo image=car.png strategy=ngd`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("distill", "ckpt", "image", "picture.mask", "data.root")
def main(cfg: DictConfig) -> float | None:
    """Returns the PSNR, which a sweep may optimise."""
    from nerfdiff.evaluation.distill import distill  # slow to import: not for --cfg

    row = distill(cfg)
    return row and row.psnr


if __name__ == "__main__":
    main()

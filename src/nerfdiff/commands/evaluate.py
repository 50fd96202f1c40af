"""Predict held-out views and score them: `python src/evaluate.py ckpt=demo data=srn_cars strategy=none`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("evaluate", "ckpt", "data.root")
def main(cfg: DictConfig) -> float | None:
    """Returns the strategy's PSNR, which a sweep may optimise."""
    from nerfdiff.evaluation.evaluate import evaluate  # slow to import: not for --cfg

    return evaluate(cfg)[0].psnr


if __name__ == "__main__":
    main()

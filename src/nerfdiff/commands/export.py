"""Weights alone, for sharing: `python src/export.py ckpt=runs/demo_checkpoint out=assets/demo dtype=float16`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("export", "ckpt")
def main(cfg: DictConfig) -> None:
    """Averaged weights as safetensors with the settings that rebuild the model."""
    from nerfdiff.checkpoint import export

    print(export(cfg.ckpt, cfg.weights, cfg.out, cfg.dtype, cfg.paths.assets_dir, cfg.average, cfg.step, cfg.shared))


if __name__ == "__main__":
    main()

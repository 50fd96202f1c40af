"""Weights alone, for sharing: `python src/export.py ckpt=runs/demo_checkpoint out=assets/demo dtype=float16`."""

from nerfdiff.commands.export import main

if __name__ == "__main__":
    main()

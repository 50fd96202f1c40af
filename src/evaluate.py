"""Predict held-out views and score them: `python src/evaluate.py ckpt=demo data=srn_cars strategy=none`."""

from nerfdiff.commands.evaluate import main

if __name__ == "__main__":
    main()

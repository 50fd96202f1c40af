"""Train NerfDiff: `python src/train.py model=large data=srn_cars data.root=/data/srn_cars`."""

from nerfdiff.commands.train import main

if __name__ == "__main__":
    main()

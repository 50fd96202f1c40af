"""Train a small model from memory: `python src/train_resident.py init=demo fresh_cdm=true minutes=3`."""

from nerfdiff.commands.train_resident import main

if __name__ == "__main__":
    main()

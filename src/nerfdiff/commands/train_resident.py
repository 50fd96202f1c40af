"""Train a small model from memory: `python src/train_resident.py init=demo fresh_cdm=true minutes=3`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("train_resident", "data.root", "init")
def main(cfg: DictConfig) -> None:
    from nerfdiff.training.resident import train_resident  # slow to import: not for --cfg

    print(train_resident(cfg))


if __name__ == "__main__":
    main()

"""Controls of the metrics, and calibration of the judge: `python src/calibrate.py part=controls data.root=…`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("calibrate")
def main(cfg: DictConfig) -> None:
    from nerfdiff.evaluation.calibrate import calibrate  # slow to import: not for --cfg

    calibrate(cfg)


if __name__ == "__main__":
    main()

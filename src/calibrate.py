"""Controls of the metrics, and calibration of the judge: `python src/calibrate.py part=controls data.root=…`."""

from nerfdiff.commands.calibrate import main

if __name__ == "__main__":
    main()

"""What metrics say of failures, and what the judge knows: `python src/calibrate.py part=controls data.root=…`."""

from nerfdiff.commands.calibrate import main

if __name__ == "__main__":
    main()

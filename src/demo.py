"""From nothing to pictures in a quarter of an hour: `python src/demo.py`, or `make demo`."""

from nerfdiff.commands.demo import main

if __name__ == "__main__":
    main()

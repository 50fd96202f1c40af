"""Look at a dataset before training on it: `python src/inspect_data.py data=srn_cars data.root=<folder>`."""

from nerfdiff.commands.inspect_data import main

if __name__ == "__main__":
    main()

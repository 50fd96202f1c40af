"""Quality against speed on one page: `python src/chart.py results=runs`."""

from nerfdiff.commands.chart import main

if __name__ == "__main__":
    main()

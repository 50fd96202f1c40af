"""Quality against speed on one page: `python src/chart.py results=runs`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("chart", "results")
def main(cfg: DictConfig) -> None:
    """Leaves a page, pictures and tables beside the results."""
    from nerfdiff.chart.build import build_chart  # slow to import: not for --cfg

    build_chart(cfg)


if __name__ == "__main__":
    main()

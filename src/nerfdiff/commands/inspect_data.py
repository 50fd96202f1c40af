"""Look at a dataset before training on it: `python src/inspect_data.py data=srn_cars data.root=<folder>`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("inspect_data", "data.root")
def main(cfg: DictConfig) -> None:
    """Exit status 1 where a scene cannot be read or a check failed, after the report is written."""
    from nerfdiff.inspection.inspect import inspect_data  # slow to import: not for --cfg

    inspect_data(cfg)


if __name__ == "__main__":
    main()

"""Turn scenes by hand in a browser: `python src/view.py field=out/car/field.safetensors`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("view", "fields")
def main(cfg: DictConfig) -> None:
    """Serves a page until Ctrl-C."""
    from nerfdiff.view.server import view  # slow to import: not for --cfg

    view(cfg)


if __name__ == "__main__":
    main()

"""From nothing to pictures in a quarter of an hour: `python src/demo.py`, or `make demo`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("demo")
def main(cfg: DictConfig) -> None:
    """Resumes where it was stopped."""
    from nerfdiff.demo import demo

    demo(cfg)


if __name__ == "__main__":
    main()

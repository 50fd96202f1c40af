"""A dataset's images in a few large files, to be streamed: `python src/make_shards.py data=srn_cars out=/fast/cars`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("make_shards", "data.root")
def main(cfg: DictConfig) -> None:
    """Splits that are there are kept."""
    from pathlib import Path

    from hydra.utils import instantiate

    from nerfdiff.data.scene import MissingSplit  # with PyTorch: not for --cfg
    from nerfdiff.data.streamed import make_shards

    data = instantiate(cfg.data)
    for stage in cfg.splits:
        folder = Path(cfg.out) / data.splits[stage]
        try:
            written = make_shards(data.reader(stage), folder, int(cfg.chunk_megabytes * 1e6), cfg.threads)
        except MissingSplit as error:
            print(f"left out: {error}")
            continue
        print(f"{folder}{'' if written else ': there already'}")


if __name__ == "__main__":
    main()

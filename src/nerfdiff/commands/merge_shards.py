"""One table and one row from all shards of a run: `python src/merge_shards.py shards=runs/distill/srn_cars`."""

from omegaconf import DictConfig

from nerfdiff.cli import entry_point


@entry_point("merge_shards", "shards")
def main(cfg: DictConfig) -> None:
    """Merge the shards of a run; merging them again changes nothing."""
    from nerfdiff.evaluation.merge import merge_shards  # slow to import: not for --cfg

    merge_shards(cfg)


if __name__ == "__main__":
    main()

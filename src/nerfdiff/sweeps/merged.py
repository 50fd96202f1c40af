"""One table and one row at the end of a sweep over shards: a Hydra callback."""

from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from nerfdiff.utils.errors import UserError


class MergeShards(Callback):
    """Does what `src/merge_shards.py shards=<the sweep's folder>` does, when the sweep ends."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Hydra lets no Exception of a callback end the command: where shards are missing, it is an exit."""
        from nerfdiff.cli import load_config
        from nerfdiff.evaluation.merge import merge_shards  # with PyTorch: not for who only launches jobs

        try:
            settings = load_config("merge_shards", [])
            settings.shards = str(config.hydra.sweep.dir)
            merge_shards(settings)
        except UserError as error:
            raise SystemExit(f"error: {error}") from error

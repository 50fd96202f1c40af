"""A part of many scenes, for one of many jobs."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from nerfdiff.utils.errors import ConfigError

T = TypeVar("T")


@dataclass(frozen=True)
class Shard:
    """Shard `number` (from 1) of `of`: every `of`-th scene, so that all shards have as many of all kinds."""

    number: int
    of: int

    @staticmethod
    def read(text: str | None) -> "Shard | None":
        """Read `3/100`; None stands for all scenes.

        Raises:
            ConfigError: it is no shard.
        """
        if text is None:
            return None
        found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", str(text))
        if not found or not 1 <= int(found[1]) <= int(found[2]):
            raise ConfigError(f"shard={text} must be a number and how many there are, from 1/100 to 100/100, or null")
        return Shard(int(found[1]), int(found[2]))

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    def share(self, items: Sequence[T]) -> Sequence[T]:
        """Deal out its items, by their index.

        Raises:
            ConfigError: there are fewer items than shards.
        """
        if self.of > len(items):
            raise ConfigError(f"shard={self}: there are {len(items)} scenes to deal out; make at most as many shards")
        return items[self.number - 1 :: self.of]

    def index(self, position: int) -> int:
        """Return the index among all items of the one at a position of this shard."""
        return self.number - 1 + position * self.of
